"""What each part of a model is worth: the scene without it, what that does to the outcome, and what it saves."""

from physjax.study.ablation.ablate import Ablation, Effect, ablate

__all__ = ["Ablation", "Effect", "ablate"]


def __dir__() -> list[str]:
    return __all__
