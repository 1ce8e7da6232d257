"""Light of the sky on lit and shaded ground."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from sattools.errors import SceneError
from sattools.fit.combinations import check_sky
from sattools.fit.illumination import material_notes
from sattools.fit.materials.blocks import shortest_half
from sattools.fit.materials.parameters import AMPLITUDE, SHAPE, diffuse
from sattools.fit.materials.scene import ReflectiveScene, restored
from sattools.fit.materials.sky import deep_shade, light_of_ground, share_in_shade, sky_directions, sky_gain
from sattools.fit.materials.start import ambient_in_shade, reflective
from sattools.fit.options import FitOptions
from sattools.fit.surface.scene import start_scene
from sattools.scene.raster import read_raster
from sattools.simulate import SimulateOptions, simulate
from sattools.views import View, load_sources, views_on

LAMBERT = (torch.tensor(1.0), torch.tensor(0.0), torch.tensor(1.0))  # k, asymmetry, rhoc of RPV


def level(rows: int, columns: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Heights and normals of level ground."""
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    return torch.zeros(rows, columns, dtype=torch.float64), up.expand(rows, columns, 3)


def test_directions_weigh_the_sky_as_an_integral_does() -> None:
    vectors = np.array([v for v, _ in sky_directions()])
    weights = np.array([w for _, w in sky_directions()])
    assert np.linalg.norm(vectors, axis=1) == pytest.approx(np.ones(len(vectors)))
    # over pi: the solid angle is 2 pi, the irradiance of level ground pi, of an upright wall pi / 2
    assert weights.sum() == pytest.approx(2.0)
    assert (weights * vectors[:, 2]).sum() == pytest.approx(1.0)
    assert (weights * np.maximum(vectors[:, 0], 0)).sum() == pytest.approx(0.5, abs=0.01)


def test_open_white_ground_sends_all_of_it_back() -> None:
    height, normal = level(5, 6)
    amplitude = torch.full((5, 6, 2), 0.4, dtype=torch.float64)
    shape = tuple(p.to(height).expand(5, 6) for p in LAMBERT)
    gain, opened = sky_gain("rpv", height, normal, 2.0, amplitude, shape)
    assert gain.numpy() == pytest.approx(np.ones((5, 6, 2)))
    assert opened.numpy() == pytest.approx(np.ones((5, 6)))


def test_ground_beside_a_wall_sees_half_the_sky() -> None:
    height, normal = level(41, 60)
    height[:, 30:] = 400.0  # a cliff, as good as infinite
    amplitude = torch.full((41, 60, 1), 0.4, dtype=torch.float64)
    shape = tuple(p.to(height).expand(41, 60) for p in LAMBERT)
    gain, opened = sky_gain("rpv", height, normal, 2.0, amplitude, shape)
    assert float(gain[20, 29, 0]) == pytest.approx(0.5, abs=0.05)
    assert float(gain[20, 45, 0]) == pytest.approx(1.0)
    assert opened[20].numpy() == pytest.approx(gain[20, :, 0].numpy())


@pytest.mark.parametrize("slope_deg", [10.0, 30.0, 60.0])
def test_a_slope_without_end_sees_the_share_of_the_sky_that_its_tilt_leaves(slope_deg: float) -> None:
    """(1 + cos) / 2; the rest is the ground at its foot."""
    tilt = np.radians(slope_deg)
    east = 2.0 * torch.arange(40, dtype=torch.float64)
    height = (-np.tan(tilt) * east).expand(9, 40).contiguous()
    normal = height.new_tensor([np.sin(tilt), 0.0, np.cos(tilt)]).expand(9, 40, 3)
    amplitude = torch.full((9, 40, 1), 0.4, dtype=torch.float64)
    shape = tuple(p.to(height).expand(9, 40) for p in LAMBERT)
    _, opened = sky_gain("rpv", height, normal, 2.0, amplitude, shape)
    assert float(opened[4, 20]) == pytest.approx((1 + np.cos(tilt)) / 2, abs=0.01)  # a quadrature of 24 directions


def test_ground_in_place_of_the_sky_sends_what_the_ground_around_reflects() -> None:
    opened = torch.tensor([[1.0, 0.75, 0.5]]).expand(3, 3)
    irradiance, reflected = torch.full((3, 3, 2), 0.8), torch.tensor([0.1, 0.5]).expand(3, 3, 2)
    light = light_of_ground(opened, irradiance, reflected, 2.0)
    assert light[1, 0].tolist() == [0.0, 0.0]
    assert light[1, 1].tolist() == pytest.approx([0.25 * 0.08, 0.25 * 0.4])
    assert light[1, 2].tolist() == pytest.approx([0.5 * 0.08, 0.5 * 0.4])
    # what is bright on one side lights the other, too: 40 m are 20 cells of these
    reflected = torch.cat([torch.full((20, 60, 1), 0.6), torch.zeros(20, 60, 1)], 0)
    light = light_of_ground(torch.full((40, 60), 0.5), torch.ones(40, 60, 1), reflected, 2.0)
    assert 0.05 < float(light[35, 30, 0]) < float(light[5, 30, 0]) < 0.3


def test_a_dark_rough_surface_sends_less_up_than_its_diffusive_reflectance() -> None:
    """Hapke's r0 is for light to all sides; upwards, and with theta-bar, less goes: another sum says how much."""
    from sattools.simulate.brdf import HAPKE, radiance_factor
    from sattools.simulate.natural_sky import sky_directions as many

    w, shape = 0.3, (0.25, 0.5, 25.0)
    expected = sum(
        weight * radiance_factor(HAPKE, 0.0, 0.0, 1.0, e, n, u, 0.0, 0.0, 1.0, w, *shape) for e, n, u, weight in many()
    )
    height, normal = level(3, 3)
    amplitude = torch.full((3, 3, 1), w, dtype=torch.float64)
    values = tuple(height.new_tensor(v).expand(3, 3) for v in shape)
    found = sky_gain("hapke", height, normal, 2.0, amplitude, values)[0] * diffuse("hapke", amplitude)
    assert float(found[1, 1, 0]) == pytest.approx(expected, rel=0.02)  # two quadratures of 24 and 72 directions
    assert expected < 0.75 * float(diffuse("hapke", amplitude)[0, 0, 0])


def test_shade_is_deep_two_cells_from_its_border() -> None:
    visibility = torch.ones(9, 9)
    visibility[1:8, 2:9] = 0.0
    deep = deep_shade(visibility)
    assert torch.nonzero(deep).tolist() == [[r, c] for r in range(3, 6) for c in range(4, 9)]


def test_the_share_is_what_shade_shows_and_its_certainty_that_of_blocks() -> None:
    shape = (48, 48)
    random = torch.Generator().manual_seed(0)
    ratio = torch.tensor([0.03, 0.05]) * (1 + 0.3 * torch.randn(2, 48 * 48, 2, generator=random))
    ratio[:, :100] = 9.0  # lit
    shade = torch.ones(2, 48 * 48)
    shade[:, :100] = 0
    share, ratio_to_error = share_in_shade(ratio, shade, shape)
    assert share.tolist() == pytest.approx([0.03, 0.05], rel=0.03)
    assert ratio_to_error > 20
    _, unsure = share_in_shade(ratio * torch.randn(2, 48 * 48, 2, generator=random), shade, shape)
    assert unsure < 3
    few = torch.zeros(2, 48 * 48)
    few[:, 500:503] = 1
    assert share_in_shade(ratio, few, shape)[1] == 0.0


def test_the_shortest_half_is_where_most_values_lie() -> None:
    assert float(shortest_half(torch.tensor([9.0, 2.0, 7.0, 2.5, 1.0]))) == pytest.approx((1.0 + 2.0 + 2.5) / 3)
    assert float(shortest_half(torch.tensor([4.0]))) == 4.0
    assert float(shortest_half(torch.tensor([1.0, 3.0]))) == 2.0


def test_sunlight_that_strays_into_half_of_the_shade_makes_no_brighter_sky() -> None:
    """Two of five blocks get up to three times the sky's light more: the median is a tenth too bright."""
    random = torch.Generator().manual_seed(3)
    block = torch.arange(48 * 48) // 48 // 8 + 10 * (torch.arange(48 * 48) % 48 // 8)
    stray = torch.where(block % 5 < 2, 0.03 + 0.06 * torch.rand(60, generator=random)[block], 0.0)
    light = 0.03 + stray + 0.003 * torch.randn(60, generator=random)[block]
    share, _ = share_in_shade(light[None, :, None], torch.ones(1, 48 * 48), (48, 48))
    assert float(share) == pytest.approx(0.03, rel=0.05)


def small_scene() -> ReflectiveScene:
    random = torch.Generator().manual_seed(1)
    draw = lambda *size: torch.rand(*size, generator=random, dtype=torch.float64)  # noqa: E731
    height = draw(4, 5)
    shape = torch.stack([p.raw(torch.tensor(p.prior_mean, dtype=torch.float64)) for p in SHAPE["hapke"]])
    scene = ReflectiveScene(
        height, draw(4, 5, 2), torch.ones(1, 2).double(), torch.zeros(1, 2).double(), 0.4 * torch.ones(1, 2).double(),
        torch.zeros(1, 2).double(), True, amplitude=draw(4, 5, 2), endmembers=shape[None],
        abundances=torch.ones(4, 5, 1).double(), cell_size=2.0,
    )  # fmt: skip
    scene.sky, scene.sky_share = 0.5 + draw(4, 5, 2), torch.tensor([0.03, 0.05], dtype=torch.float64)
    return scene


def test_sky_light_is_added_to_lit_and_shaded_ground_alike() -> None:
    scene = small_scene()
    sun, up = (torch.tensor(v, dtype=torch.float64) for v in ((0.6, 0.0, 0.8), (0.0, 0.0, 1.0)))
    with_sky = scene.light(sun, up, None, scene.ambient[0])
    shaded = scene.light(sun, up, torch.zeros(4, 5).double(), scene.ambient[0])
    sky = scene.sky_share * scene.sky * diffuse("hapke", AMPLITUDE["hapke"].bounded(scene.amplitude))
    assert torch.equal(shaded, sky)
    scene.sky = torch.zeros(0)
    assert with_sky.numpy() == pytest.approx((scene.light(sun, up, None, scene.ambient[0]) + sky).numpy())
    assert "ambient" in scene.trainable()


def test_light_of_the_ground_around_is_added_to_lit_and_shaded_ground_alike() -> None:
    scene = small_scene()
    sun, up = (torch.tensor(v, dtype=torch.float64) for v in ((0.6, 0.0, 0.8), (0.0, 0.0, 1.0)))
    half = torch.cat([torch.ones(2, 5), torch.zeros(2, 5)]).double()
    plain = scene.light(sun, up, half, scene.ambient[0])
    scene.opened = torch.ones(4, 5).double()
    assert torch.equal(scene.light(sun, up, half, scene.ambient[0]), plain)  # open ground gets none
    scene.opened = torch.full((4, 5), 0.9).double()
    reflected = diffuse("hapke", AMPLITUDE["hapke"].bounded(scene.amplitude))
    around = scene.bounced(sun, half)
    assert bool((around > 0).all())
    assert float(around.max()) < 0.1 * float(reflected.max())  # a tenth of the hemisphere, at most all lit
    found = scene.light(sun, up, half, scene.ambient[0])
    assert found.numpy() == pytest.approx((plain + around * reflected).numpy())
    again = restored(scene.tensors(), "hapke", 2.0, 0.0, True)
    assert torch.equal(again.light(sun, up, half, scene.ambient[0]), found)


def test_a_sky_that_is_asked_for_and_not_found_is_said(caplog: pytest.LogCaptureFixture) -> None:
    """The light is then that of a fit without a sky, whatever the options in the history are."""
    scene = small_scene()
    std = {p.name: scene.height for p in SHAPE["hapke"]}
    assert len(material_notes(scene, std, "fitted")) == 1
    scene.sky, scene.sky_share = torch.zeros(0), torch.zeros(0)
    assert len(material_notes(scene, std, "none")) == 1
    assert material_notes(scene, std, "auto")[1:] == ["no light of the sky was kept: shade does not surely show any"]
    assert not caplog.text
    (told,) = material_notes(scene, std, "fitted")[1:]
    assert told.startswith("--sky fitted found no light of the sky")
    assert told in caplog.text


def test_the_light_in_shade_begins_as_deep_shade_shows_it() -> None:
    """Three views: one of them shows 40 cells of shade, one too few of them, one none."""
    scene = small_scene()
    scene.sky = torch.zeros(0)
    scene.amplitude = torch.zeros(8, 5, 2).double()  # w = 0.49 everywhere
    scene.ambient = torch.full((3, 2), 0.4, dtype=torch.float64)
    usual = diffuse("hapke", AMPLITUDE["hapke"].bounded(scene.amplitude))
    everywhere, one, none = torch.ones(8, 5).double(), torch.zeros(8, 5).double(), torch.zeros(8, 5).double()
    one[0, 0] = 1
    light = usual * torch.tensor([0.05, 0.08])
    found = ambient_in_shade(scene, [(light, everywhere), (10 * light, one), (10 * light, none)])
    # the views that do not show it get what the first one shows
    assert found.numpy() == pytest.approx(np.tile([0.05, 0.08], (3, 1)))
    assert ambient_in_shade(scene, [(light, none)] * 3).numpy() == pytest.approx(np.full((3, 2), 0.4))


def test_gradients_of_light_with_a_sky() -> None:
    scene = small_scene()
    sun, up = (torch.tensor(v, dtype=torch.float64) for v in ((0.6, 0.0, 0.8), (0.05, 0.0, 0.99875)))
    visibility = torch.linspace(0.0, 1.0, 20, dtype=torch.float64).reshape(4, 5)

    def light(height: torch.Tensor, amplitude: torch.Tensor, share: torch.Tensor) -> torch.Tensor:
        scene.height, scene.amplitude, scene.sky_share = height, amplitude, share
        return scene.light(sun, up, visibility, scene.ambient[0])

    leaves = (scene.height, scene.amplitude, scene.sky_share)
    assert torch.autograd.gradcheck(light, [t.clone().requires_grad_(True) for t in leaves])
    assert "ambient" not in scene.trainable()


def true_ground(options: SimulateOptions, folder: Path) -> tuple[torch.Tensor, list[View]]:
    """The true heights of a simulated scene, and its views."""
    scene = simulate(options, folder / "SKY")
    height = torch.from_numpy(read_raster(scene.path(scene.products["truth_dsm"]))[0][0].astype(np.float32))
    grid, z_range = scene.require_grid(), scene.require_height_range()
    return height, list(views_on(load_sources(scene, scene.items), grid, float(height.mean()), z_range))


@pytest.mark.parametrize("sky", [0.0, 0.08])
def test_auto_finds_the_sky_that_is_there_and_none_else(tmp_path: Path, sky: float) -> None:
    """On the true heights of steep ground under a low sun."""
    options = SimulateOptions(
        terrain="natural", id="SKY", size=96.0, views=3, train=3, units=2, seed=5, slope=40.0, off_nadir=10.0,
        sun_elevation=35.0, sky=sky,
    )  # fmt: skip
    height, views = true_ground(options, tmp_path)
    ones = torch.ones(3, 3)
    start = start_scene(height, torch.zeros(*height.shape, 3), ones, 0 * ones, 0.4, absolute=True)
    asked: dict[str, Any] = {"endmembers": 4, "smooth": 0.0, "seed": 0, "sky": "auto"}
    found, _ = reflective(start, "hapke", views, [1.0] * 3, 2.0, **asked)
    assert found.has_sky == (sky > 0)
    if not sky:
        plain, _ = reflective(start, "hapke", views, [1.0] * 3, 2.0, **asked | {"sky": "none"})
        assert torch.equal(found.amplitude, plain.amplitude)
        assert torch.equal(found.endmembers, plain.endmembers)
    bounced, _ = reflective(start, "hapke", views, [1.0] * 3, 2.0, **asked, bounce=True)
    assert (bounced.opened.numel() > 0) == (sky > 0)
    if sky:
        given = asked | {"sky": found.sky_share.tolist()}
        alone, bounced = (
            reflective(start, "hapke", views, [1.0] * 3, 2.0, **given, bounce=bounce)[0] for bounce in (False, True)
        )
        # the mean slope is 40 degrees; what other ground lights is not taken for the ground's own reflectance
        assert 0.7 < float(bounced.opened.mean()) < 0.97
        assert 0.001 < float(alone.values()[0].mean() - bounced.values()[0].mean()) < 0.05
        # the simulator's red, green, blue; the ground in shade is taken for its material's mean
        assert found.sky_share.numpy() == pytest.approx(0.08 * np.array([0.75, 1.0, 1.3]), rel=0.2)
        (note,) = material_notes(found, {p.name: found.height for p in SHAPE["hapke"]})
        assert "% of the sun's in the bands (from shade" in note
        again = restored(found.tensors(), "hapke", 2.0, 0.0, absolute=True)
        lights = [s.light(s.suns[0], s.view_vectors[0], None, s.ambient[0]) for s in (found, again)]
        assert torch.equal(*lights)  # a model's file holds the sky


def test_shade_that_no_view_shows_says_nothing_of_the_sky(tmp_path: Path) -> None:
    """It would be black, and where images end most of the ground in deep shade may lie beyond them."""
    options = SimulateOptions(
        terrain="natural", id="SKY", size=96.0, views=3, train=3, units=2, seed=5, slope=40.0, off_nadir=10.0,
        sun_elevation=35.0, sky=0.08,
    )  # fmt: skip
    height, views = true_ground(options, tmp_path)
    inside = np.zeros(height.shape, bool)
    inside[:, : height.shape[1] * 2 // 5] = True
    cut = [
        replace(v, target=np.where(inside[..., None], v.target, 0).astype(v.target.dtype),
                mask=np.where(inside, v.mask, 0).astype(v.mask.dtype))
        for v in views
    ]  # fmt: skip
    ones = torch.ones(3, 3)
    start = start_scene(height, torch.zeros(*height.shape, 3), ones, 0 * ones, 0.4, absolute=True)
    found, _ = reflective(start, "hapke", cut, [1.0] * 3, 2.0, endmembers=4, smooth=0.0, seed=0, sky="auto")
    assert found.has_sky
    assert found.sky_share.numpy() == pytest.approx(0.08 * np.array([0.75, 1.0, 1.3]), rel=0.25)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (FitOptions(brdf="hapke", sky_share=[0.03, 0.04]), "found 2 values, expected 1 or 3"),
        (FitOptions(sky="auto"), "found --brdf lambert"),
        (FitOptions(sky_share=[0.03], brdf="hapke", field="mlp"), "--field mlp"),
        (FitOptions(brdf="hapke", bounce=True), "--bounce: found no sky"),
    ],
)
def test_a_sky_that_cannot_be_is_refused(options: FitOptions, message: str) -> None:
    with pytest.raises(SceneError, match=message):
        check_sky(options, 3)
    check_sky(FitOptions(brdf="hapke", sky_share=[0.03]), 8)
