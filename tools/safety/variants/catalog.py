"""List all variants, module by module."""

from __future__ import annotations

from tools.safety.variants import archives, folders, masks, models, names, orientations

VARIANT_MODULES = (names, folders, models, orientations, masks, archives)
ALL_VARIANTS = tuple(variant for module in VARIANT_MODULES for variant in module.list_variants())
