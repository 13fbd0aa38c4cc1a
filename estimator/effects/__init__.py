"""The library of named effects, one file each; ``estimator.effects.library`` registers all that are shipped."""

from estimator.effects.declaration import (
    ENVIRONMENT,
    Effect,
    EffectInstance,
    Layout,
    Parameter,
    Sample,
    axes,
    declare,
    register,
    registry,
)

__all__ = [
    "ENVIRONMENT",
    "Effect",
    "EffectInstance",
    "Layout",
    "Parameter",
    "Sample",
    "axes",
    "declare",
    "register",
    "registry",
]
