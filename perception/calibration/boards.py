"""Calibration boards: their appearance and the positions of their points in an image."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array
from hal.errors import NotFound

# Noise of a refined ChArUco corner; calibrations on sharp images give residuals of 0.05 to 0.2 px rms.
CORNER_SIGMA_PX = 0.1
DOT_SIGMA_PX = 0.05  # noise of the middle of a dot
FEWEST_POINTS = 6  # in a view of a board


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BoardView:
    """Known points seen in one image.

    Attributes:
        points_m: (N, 3) in the board's (or panel's) frame.
        pixels_px: (N, 2) as measured.
        sigma_px: noise of each coordinate.
        disc_m: radius of the flat disc whose middle a point is; 0 for a corner. The middle of a disc's image is not the
            image of its middle, see `disc_offset_px`.
    """

    points_m: Array
    pixels_px: Array
    sigma_px: float
    disc_m: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Charuco:
    """A chessboard with ArUco markers in its white squares; a part of it may be out of view.

    `columns` x `rows` squares of `square_m` with markers of `marker_m` from OpenCV's dictionary `dictionary`.
    Frame: origin at the outer corner of the first square, x along the columns, y along the rows, z into the board.
    """

    columns: int = 9
    rows: int = 6
    square_m: float = 0.03
    marker_m: float = 0.022
    dictionary: str = "DICT_5X5_100"

    def _board(self) -> Any:
        """Build OpenCV's description of the board."""
        words = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary))
        return cv2.aruco.CharucoBoard((self.columns, self.rows), self.square_m, self.marker_m, words)

    def draw(self, square_px: int) -> NDArray[np.uint8]:
        """Return the board to print as a gray image (rows * square_px, columns * square_px), without a margin."""
        size = (self.columns * square_px, self.rows * square_px)
        return np.asarray(self._board().generateImage(size, marginSize=0, borderBits=1), np.uint8)

    def find(self, image: NDArray[np.uint8]) -> BoardView:
        """Find the inner corners that are visible in a gray image (H, W).

        Raises:
            NotFound: fewer than six corners.
        """
        board = self._board()
        corners, ids, _, _ = cv2.aruco.CharucoDetector(board).detectBoard(image)
        if ids is None or len(ids) < FEWEST_POINTS:
            raise NotFound(
                f"{0 if ids is None else len(ids)} corners of the ChArUco board are visible",
                hint="check dictionary and squares, come nearer, or light the board evenly",
            )
        points = np.asarray(board.getChessboardCorners(), float)[np.asarray(ids).ravel()]
        return BoardView(points_m=points, pixels_px=np.asarray(corners, float).reshape(-1, 2), sigma_px=CORNER_SIGMA_PX)


@dataclass(frozen=True, slots=True, kw_only=True)
class Dots:
    """A grid of `columns` x `rows` black dots, `spacing_m` apart, which must be in view as a whole.

    Frame: origin at the first dot, z into the board. If the grid looks the same after half a turn, the order of its
    dots is ambiguous; the pose of the board then differs by that half turn, and the calibration does not.
    """

    columns: int = 8
    rows: int = 6
    spacing_m: float = 0.03

    def points_m(self) -> Array:
        """Return the points (columns * rows, 3), row by row."""
        y, x = np.mgrid[: self.rows, : self.columns]
        return np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)]) * self.spacing_m

    def find(self, image: NDArray[np.uint8]) -> BoardView:
        """Find the dots in a gray image (H, W).

        Raises:
            NotFound: not the whole grid is visible.
        """
        found, centres = cv2.findCirclesGrid(image, (self.columns, self.rows), flags=cv2.CALIB_CB_SYMMETRIC_GRID)
        if not found:
            raise NotFound(
                f"the grid of {self.columns}x{self.rows} dots is not visible as a whole",
                hint="show every dot, with a bright margin round the grid, and light it evenly",
            )
        pixels = np.asarray(centres, float).reshape(-1, 2)
        return BoardView(
            points_m=self.points_m(), pixels_px=pixels, sigma_px=DOT_SIGMA_PX, disc_m=self._radius_m(image, pixels)
        )

    def _radius_m(self, image: NDArray[np.uint8], centres_px: Array) -> float:
        """Return the radius of the dots, from the ratio of a dot's dark area to the area of one cell of the grid."""
        grid = centres_px.reshape(self.rows, self.columns, 2)
        across, down = np.asarray(np.gradient(grid, axis=1)), np.asarray(np.gradient(grid, axis=0))
        cell_px = np.abs(across[..., 0] * down[..., 1] - across[..., 1] * down[..., 0]).ravel()
        dots = np.round(centres_px).astype(int)
        between = np.round(0.25 * (grid[:-1, :-1] + grid[1:, :-1] + grid[:-1, 1:] + grid[1:, 1:])).astype(int)
        level = 0.5 * (np.median(image[dots[:, 1], dots[:, 0]]) + np.median(image[between[..., 1], between[..., 0]]))
        _, labels, stats, _ = cv2.connectedComponentsWithStats((image < level).astype(np.uint8))
        area_px = stats[labels[dots[:, 1], dots[:, 0]], cv2.CC_STAT_AREA]
        radius_m = self.spacing_m * float(np.sqrt(np.median(area_px / cell_px) / np.pi))
        return min(radius_m, 0.5 * self.spacing_m)
