"""A pushbroom camera in orbit, and the RPC that stands for it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sattools.camera.ground import from_geographic, to_geographic
from sattools.camera.rpc import RPC
from sattools.camera.rpc_polynomials import monomials

ORBIT_M = 617_000.0  # WorldView-3
VALIDITY_DEG = 0.01
VALIDITY_M = 500.0


@dataclass(frozen=True)
class Pushbroom:
    """Each row is seen from a point that moves on a line, in a plane across it; the attitude does not change.

    Coordinates are (easting, northing, height) of a projected CRS, taken as Cartesian. Pixel (col, row) looks from
    `origin` + (row - row0) `velocity` along `look` + (col - col0) / `focal` `across`.
    """

    origin: np.ndarray
    velocity: np.ndarray
    look: np.ndarray
    across: np.ndarray
    focal: float
    col0: float
    row0: float

    @classmethod
    def towards(
        cls, target: np.ndarray, view: np.ndarray, pixel_m: float, shape: tuple[int, int], yaw_deg: float = 0.0
    ) -> Pushbroom:
        """A camera whose middle pixel sees `target`, from the direction `view` (unit vector to the sensor).

        `pixel_m`: edge of a pixel across the line of sight; `yaw_deg` turns the rows' direction from south to west.

        Args:
            target: ``[3]`` (easting, northing, height) [m].
            view: ``[3]`` unit vector to the sensor.
            pixel_m: see above.
            shape: (rows, columns) [px].
            yaw_deg: see above.
        """
        yaw = np.radians(yaw_deg)
        track = np.array([-np.sin(yaw), -np.cos(yaw), 0.0])
        look = -np.asarray(view, np.float64)
        across = np.cross(track, look)
        across /= np.linalg.norm(across)
        normal = np.cross(look, across)
        distance = ORBIT_M / view[2]
        velocity = track * pixel_m / (track @ normal)
        height, width = shape
        return cls(
            target - look * distance,
            velocity,
            look,
            across,
            distance / pixel_m,
            (width - 1) / 2,
            (height - 1) / 2,
        )

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(col, row) [px] of ground points [..., 3] [m]; exact."""
        normal = np.cross(self.look, self.across)
        offset = points - self.origin
        along = (offset @ normal) / (self.velocity @ normal)
        offset = offset - along[..., None] * self.velocity
        col = self.focal * (offset @ self.across) / (offset @ self.look)
        return col + self.col0, along + self.row0

    def seen(self, col: np.ndarray, row: np.ndarray, height: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Points [..., 3] [m] of these heights that pixels show, and the directions [..., 3] in which they look.

        Args:
            col: of the pixels.
            row: of the pixels.
            height: of the points [m].
        """
        origin = self.origin + (row - self.row0)[..., None] * self.velocity
        line = self.look + ((col - self.col0) / self.focal)[..., None] * self.across
        times = (height - origin[..., 2]) / line[..., 2]
        return origin + times[..., None] * line, line


def fit_rpc(camera: Pushbroom, crs: str, centre: tuple[float, float, float]) -> tuple[RPC, float]:
    """RPC of a camera around (easting, northing, height), and its largest error in pixels between the fitted points.

    Valid to 0.01° and 500 m about the centre, as wide as a vendor's, so that its limits tell nothing about the scene.
    The denominators are 1: over this cube a cubic describes the perspective to far below a thousandth of a pixel.

    Args:
        camera: to be expressed.
        crs: projected ground CRS [m].
        centre: (easting, northing, height) [m].
    """
    lon, lat = (float(v) for v in to_geographic(crs, centre[0], centre[1]))
    lon, lat, alt = round(lon, 4), round(lat, 4), float(round(centre[2]))

    def cube(count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        nodes = np.cos(np.pi * (np.arange(count) + 0.5) / count)
        x, y, z = (g.ravel() for g in np.meshgrid(nodes, nodes, nodes, indexing="ij"))
        return x, y, z

    def pixels(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        east, north = from_geographic(crs, lon + VALIDITY_DEG * x, lat + VALIDITY_DEG * y)
        return camera.project(np.stack([east, north, alt + VALIDITY_M * z], axis=-1))

    x, y, z = cube(9)
    col, row = pixels(x, y, z)
    col_scale, row_scale = float(np.ptp(col) / 2), float(np.ptp(row) / 2)
    basis = monomials(x, y, z).T
    normalised = np.stack([(col - camera.col0) / col_scale, (row - camera.row0) / row_scale], axis=1)
    col_num, row_num = np.linalg.lstsq(basis, normalised, rcond=None)[0].astype(np.float64).T
    one = np.eye(20, dtype=np.float64)[0]
    rpc = RPC(
        camera.row0, camera.col0, lat, lon, alt, row_scale, col_scale,
        VALIDITY_DEG, VALIDITY_DEG, VALIDITY_M, row_num, one, col_num, one,
    )  # fmt: skip
    x, y, z = cube(8)
    col, row = pixels(x, y, z)
    got = rpc.projection(lon + VALIDITY_DEG * x, lat + VALIDITY_DEG * y, alt + VALIDITY_M * z)
    return rpc, float(np.hypot(got[0] - col, got[1] - row).max())
