"""All variants, family by family."""

from __future__ import annotations

from tools.safety.variants import archives, folders, masks, models, names, turned

FAMILIES = (names, folders, models, turned, masks, archives)
VARIANTS = tuple(variant for family in FAMILIES for variant in family.variants())
