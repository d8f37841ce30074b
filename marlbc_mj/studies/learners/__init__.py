"""A study of learners: variants, each trained on several seeds, and their comparison."""

from marlbc_mj.studies.learners.variants import VARIANTS, Variant

__all__ = ["VARIANTS", "Variant"]
