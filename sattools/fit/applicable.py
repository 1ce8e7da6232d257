"""Options of a fit that do nothing beside the others: who gives one on the command line expects it to do something."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import NamedTuple

from sattools.field.networks import NETWORKS
from sattools.fit.options import FitOptions


class Needed(NamedTuple):
    """What an option needs to do anything.

    Attributes:
        met: whether that is there.
        found: names of the options that decide it.
        expected: what they have to be, in words.
    """

    met: Callable[[FitOptions], bool]
    found: tuple[str, ...]
    expected: str


def _has_head(options: FitOptions, *heads: str) -> bool:
    return options.field == "mlp" and not NETWORKS[options.network].heads.keys().isdisjoint(heads)


_SURFACE = Needed(lambda o: o.field == "surface", ("field",), "--field surface")
_RAYS = Needed(lambda o: o.field != "surface", ("field",), "--field mlp, neural or voxel (or a preset with one)")
_STARTED = Needed(lambda o: o.field in ("mlp", "neural"), ("field",), "--field mlp or neural (or a preset with one)")
_NETWORK = Needed(lambda o: o.field == "mlp", ("field",), "--field mlp (or a preset with a network)")
_REFLECTING = Needed(lambda o: o.brdf != "lambert", ("brdf",), "--brdf rpv, hapke or auto")
_MATERIALS = Needed(
    lambda o: o.brdf != "lambert" and o.field == "surface", ("brdf", "field"),
    "--brdf rpv, hapke or auto with --field surface",
)  # fmt: skip
_REFLECTING_NETWORK = Needed(
    lambda o: o.brdf != "lambert" and o.field == "mlp", ("brdf", "field"), "--brdf rpv or hapke with --field mlp"
)
_LEARNED = Needed(lambda o: o.shadow in ("learned", "auto"), ("shadow",), "--shadow learned or auto")
_LIGHT = Needed(
    lambda o: o.shadow in ("learned", "auto") or (o.field == "mlp" and o.shadow != "none"), ("shadow", "field"),
    "--shadow learned or auto, or --field mlp with shadows",
)  # fmt: skip
_UNCERTAIN = Needed(
    lambda o: _has_head(o, "beta", "transient"), ("field", "network"), "--field mlp with --network satnerf or eonerf"
)
_TRANSIENT = Needed(
    # `check_combination` refuses auto
    lambda o: o.field == "surface" or o.transient == "auto" or _has_head(o, "transient"), ("field", "network"),
    "--field surface, or mlp with --network eonerf",
)  # fmt: skip
_SOLAR = Needed(
    lambda o: o.shadow == "learned" and _has_head(o, "sun"), ("field", "network", "shadow"),
    "--field mlp with --network satnerf or eonerf-learned-shadow and --shadow learned",
)  # fmt: skip
NEEDED = {
    **dict.fromkeys(("coarsest", "epochs", "softness", "smooth", "height_rate"), _SURFACE),
    **dict.fromkeys(("rays", "samples", "guided", "steps", "depth_weight"), _RAYS),
    **dict.fromkeys(("network", "width", "rate", "precision"), _NETWORK),
    **dict.fromkeys(("pretrain", "normals"), _REFLECTING),
    **dict.fromkeys(("materials", "material_smooth"), _MATERIALS),
    "start": _STARTED, "brdf_at": _REFLECTING_NETWORK, "shadow_weight": _LEARNED, "shadow_start": _LIGHT,
    "beta": _UNCERTAIN, "transient": _TRANSIENT, "solar_weight": _SOLAR,
}  # fmt: skip


def without_effect(options: FitOptions, given: Iterable[str]) -> list[tuple[str, str]]:
    """Those of some options that do nothing beside the others, each with what was found and expected.

    One that was given the value that it has anyway asks for nothing.

    Args:
        options: of the fit.
        given: names of options that the user gave.
    """
    plain, idle = FitOptions(), []
    for name in given:
        needed = NEEDED.get(name)
        if needed is None or getattr(options, name) == getattr(plain, name) or needed.met(options):
            continue
        found = " and ".join(f"--{other} {getattr(options, other)}" for other in needed.found)
        idle.append((name, f"found {found}, expected {needed.expected}"))
    return idle


__all__ = ["NEEDED", "without_effect"]
