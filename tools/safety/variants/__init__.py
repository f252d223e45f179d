"""Check that `hyrfpack.load_scene` reads a data set in every form in which users may have it.

Photos and poses reach users under other names, in other folders, formats and archives, rotated, masked or incomplete.
A variant is one such change to a set that is known to be read. It must give the cameras and pictures of the original
set, or an error that says what is wrong. Silently wrong poses or pictures would only show as a bad model, after hours
of training.

    python -m tools.safety.variants SET [SET ...]       all variants of real sets; run it after a change in `data/`

`tests/data/test_variants.py` runs each variant on a small rendered set, in one of its layouts.

    variant         `Variant`: a name, a change, and what reading must give
    working_set     `WorkingSet`: the copy of a set that a variant changes
    names, folders, models, orientations, masks, archives
                    the variants, by what they change; `catalog` lists them all
    check           builds a variant, reads it, and checks the result
    differences     compares the cameras, pictures and masks of two scenes

A reader of a new layout, and a repaired one, get a variant in the module of its topic.
"""
