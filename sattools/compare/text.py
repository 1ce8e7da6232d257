"""Figures of a comparison as JSON, and for people."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any

from sattools.compare.steps import step_text
from sattools.errors import counted


def to_json(figures: Mapping[str, Any], indent: int | None = None) -> str:
    """The figures as JSON; what is infinite (the PSNR of equal images) becomes null, which JSON can say."""

    def plain(value: Any) -> Any:
        if isinstance(value, Mapping):
            return {key: plain(inner) for key, inner in value.items()}
        return None if isinstance(value, float) and not math.isfinite(value) else value

    return json.dumps(plain(figures), indent=indent, allow_nan=False)


def table(figures: Mapping[str, Any]) -> str:
    """The figures for people: a few lines of text."""
    east, north, up = figures["shift_m"]
    name = figures.get("scene") or figures.get("predicted", "")
    lines = [
        f"{name} against {figures['reference']} ({figures['protocol']})",
        f"  MAE {figures['mae']:.3f} m   holes filled {figures['mae_filled']:.3f} m   RMSE {figures['rmse']:.3f} m   "
        f"median {figures['median']:.3f} m   NMAD {figures['nmad']:.3f} m",
        f"  completeness {100 * figures['completeness']:.2f} % (MAE there {_text(figures['measured']['mae'])} m)   "
        f"within 1 m {100 * figures['within_1m']:.1f} %   within 2.5 m {100 * figures['within_2_5m']:.1f} %   "
        f"of {counted(figures['cells'], 'cells')}",
        f"  shift {east:+.2f} m east, {north:+.2f} m north, {up:+.2f} m up ({figures['registration']['method']})",
        f"  {step_text(figures)}",
        f"  scored: {figures['mask']}",
    ]
    for name, errors in figures.get("classes", {}).items():
        if errors["n"]:
            lines.append(f"  {name:9s} MAE {errors['mae']:.3f} m   median {errors['median']:.3f} m   n {errors['n']}")
    for name, errors in figures.get("parameters", {}).items():
        if not errors["n"]:
            lines.append(f"  {name:9s} no cell was determined: nothing to score")
            continue
        lines.append(f"  {name:9s} {_map_text(errors)}   correlation {_text(errors['correlation'])}")
    for row in figures.get("points", []):
        values = (
            f"{key} {_text(v['map'])} (sample {_text(v['sample'])}, difference {_text(v['difference'])})"
            for key, v in row["values"].items()
        )
        lines.append(f"  {row['name']:9s} " + "   ".join(values))
    if "psnr" in figures:
        means = "   ".join(f"{k} {_text(figures[k])}" for k in ("psnr", "ssim", "lpips", "avg"))
        lines.append(f"  views     {means}   {_whose(figures['views'])}")
    return "\n".join(lines)


def _map_text(errors: Mapping[str, Any]) -> str:
    """The error of a map, over the reference's mean where that is one to divide by: an asymmetry's is about 0."""
    if errors["nrmse"] is None:
        return f"RMSE {_text(errors['rmse'])} (no NRMSE, as the reference's mean is not above 0)"
    return (
        f"NRMSE {_text(errors['nrmse'])} (constant map {_text(errors['nrmse_constant'])}, "
        f"one factor {_text(errors['nrmse_scaled'])})"
    )


def _whose(views: Mapping[str, Any]) -> str:
    """Which views the means are of: a fit shows images that it has seen better than any other."""
    held_out = sum(view["role"] == "test" for view in views.values())
    if held_out:
        return f"({held_out} held out from the fit)"
    return f"({len(views)} that the fit was trained on, none held out)"


def _text(value: float | None) -> str:
    return "n/a" if value is None else f"{value:.3f}"


__all__ = ["table", "to_json"]
