"""Options of a fit that do not go with each other, asked before anything is read or matched."""

from __future__ import annotations

from sattools.errors import SceneError, counted
from sattools.field.networks import DEPTH, NETWORKS
from sattools.fit.options import FitOptions
from sattools.scene.memory import check_memory

PLAIN = ("voxel", "neural")  # fields without heads
LEAST_HELD = 16  # place, density, colour, and what is made of them


def check_combination(options: FitOptions, bands: int | None) -> None:
    """Raise SceneError where the options of a fit cannot work together.

    Args:
        options: of the fit.
        bands: of the images; None = nobody knows yet.
    """
    check_sky(options, bands)
    with_prior = options.prior_weight > 0
    if options.field != "surface":
        _check_rays(options, with_prior)
    elif options.brdf != "lambert" and not with_prior and (options.normals == "prior" or options.brdf == "auto"):
        asked = "--normals prior" if options.normals == "prior" else "--brdf auto"
        raise SceneError(f"{asked}: found no prior, expected one (--prior-weight above 0)")


def check_sky(options: FitOptions, bands: int | None) -> None:
    """Raise SceneError where a sky is asked for without a reflectance model, or of another number of bands."""
    if options.sky == "none" and not options.sky_share:
        if options.bounce:
            raise SceneError("--bounce: found no sky, expected --sky fitted, --sky auto or --sky-share")
        return
    if options.brdf == "lambert" or options.field != "surface":
        asked = "--sky" if options.sky != "none" else "--sky-share"
        raise SceneError(
            f"{asked}: found --brdf {options.brdf} and --field {options.field}, expected rpv, hapke or auto on a "
            "surface"
        )
    if bands is not None and options.sky_share and len(options.sky_share) not in (1, bands):
        raise SceneError(
            f"--sky-share: found {counted(len(options.sky_share), 'values')}, expected 1 or {bands}, one per band"
        )


def starts_from_prior(options: FitOptions) -> bool:
    """Whether a field begins as a surface, the fitted or the matched one."""
    return options.field in ("mlp", "neural") and options.start != "noise"


def _check_rays(options: FitOptions, with_prior: bool) -> None:
    """The same of a field that is trained ray by ray."""
    if options.guided and not with_prior:
        raise SceneError("--guided: found no prior to sample around, expected --prior-weight above 0")
    if options.field == "neural" and options.start == "noise":
        raise SceneError("--field neural: found --start noise, expected --start surface or prior")
    if starts_from_prior(options) and not with_prior:
        raise SceneError(f"--start {options.start}: found no prior, expected --prior-weight above 0 (or --start noise)")
    _check_light(options)
    _check_reflectance(options, with_prior)


def _check_light(options: FitOptions) -> None:
    lit = options.field == "mlp" and "sun" in NETWORKS[options.network].heads
    if options.field == "mlp" and options.shadow == "learned" and not lit:
        raise SceneError(f"--shadow learned: network {options.network} has no head for it, expected --shadow geometric")
    if options.solar_weight > 0 and not lit:
        raise SceneError("--solar-weight: expected a network with learned shadows, --network satnerf")
    if options.field in PLAIN and options.shadow == "learned":
        raise SceneError(f"--shadow learned: a {options.field} field has no head for it, expected --shadow geometric")
    if options.shadow == "auto" or options.transient == "auto":
        raise SceneError("--shadow auto, --transient auto: expected --field surface; name the model for other fields")


def _check_reflectance(options: FitOptions, with_prior: bool) -> None:
    if options.brdf == "lambert":
        return
    if options.brdf == "auto":
        raise SceneError("--brdf auto: expected --field surface; name the model for other fields")
    if options.field in PLAIN:
        raise SceneError(f"--brdf {options.brdf}: a {options.field} field has no head for it, expected --brdf lambert")
    if options.network != options.brdf:
        raise SceneError(
            f"--brdf {options.brdf}: network {options.network} has no head for it, expected --network {options.brdf}"
        )
    if options.normals != "prior" or not with_prior:
        raise SceneError(
            f"--brdf {options.brdf} with --field mlp: found no prior for its normals, expected --normals prior and a "
            "--prior-weight above 0"
        )


def check_step(options: FitOptions) -> None:
    """Raise SattoolsError where the samples of one step of a field of rays are surely more than memory holds."""
    samples = options.rays * (options.samples + options.guided)
    check_memory(step_bytes(options), f"--rays {options.rays}: {samples} samples a step", "fewer --rays or --samples")


def step_bytes(options: FitOptions) -> float:
    """Bytes that one step of a field of rays surely takes."""
    size, held = 4.0, LEAST_HELD  # bytes of a number; numbers of a sample that wait for the way back
    if options.field == "mlp":
        network = NETWORKS[options.network]
        held = DEPTH * (options.width or network.width)
        size = 2.0 if options.precision == "bf16" else size
    return size * held * options.rays * (options.samples + options.guided)


__all__ = ["check_combination", "check_sky", "check_step", "starts_from_prior", "step_bytes"]
