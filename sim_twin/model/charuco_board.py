"""A printed board, such as a ChArUco one, that lies on the twin's table where it is known to a hair."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import mujoco
import numpy as np

from hal.base.errors import InvalidValueError
from hal.base.messages import Intrinsics
from sim_twin.model.z1_mjcf import BIT_BASE, BIT_GRIPPER, BIT_SCENE, CONTACT_SOLIMP, CONTACT_SOLREF, GROUP_SCENE

PRINT_GEOM = "board_print"
"""Name of the geom that carries the picture."""
THICKNESS_M = 0.003
"""An aluminium composite plate, as boards are mounted on [m]."""
MARGIN_M = 0.008
"""White border around the picture [m]."""

_INK_M = 2e-5  # the picture's geom stands out that much, so that it is drawn before the plate
_X_M, _Y_M = (0.25, 0.70), (-0.30, 0.30)
_SUPERSAMPLING = 3


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BoardSpec:
    """What is printed, how large, and where it lies.

    Raises:
        ValueError: no picture, or it lies where the arm cannot look at it.
    """

    image: np.ndarray
    """(H, W) uint8, the picture as it is read, without border."""
    size_m: tuple[float, float]
    """Width and height of the picture [m]."""
    x_m: float = 0.42
    """Middle of the picture in front of the base [m]."""
    y_m: float = 0.0
    """The same to the left [m]."""
    yaw_deg: float = 0.0
    """Turn about the base's z axis [°]; at 0 the picture's upper edge is the one away from the base."""

    def __post_init__(self) -> None:
        image = np.array(self.image)
        if image.ndim != 2 or image.dtype != np.uint8 or not image.size:
            raise InvalidValueError(f"the board's picture is {image.dtype} {image.shape}; it must be uint8 (H, W).")
        image.setflags(write=False)
        object.__setattr__(self, "image", image)
        if not all(0.02 <= length <= 0.6 for length in self.size_m):
            raise InvalidValueError(f"the board measures {self.size_m} m; the twin takes 0.02 to 0.6 m.")
        for name, (low, high) in (("x_m", _X_M), ("y_m", _Y_M)):
            if not low <= getattr(self, name) <= high:
                raise InvalidValueError(
                    f"the board's {name} is {getattr(self, name)}; in reach are {low:g} to {high:g} m."
                )
        if not np.isfinite(self.yaw_deg):
            raise InvalidValueError(f"the board's yaw_deg is {self.yaw_deg}; it must be finite.")

    def T_base_board(self) -> np.ndarray:
        """Return where it lies (4, 4): origin at the picture's upper left corner, x right, y down, z into the table."""
        yaw = np.deg2rad(self.yaw_deg)
        c, s = np.cos(yaw), np.sin(yaw)
        pose = np.eye(4)
        pose[:3, :3] = np.column_stack([(s, -c, 0.0), (-c, -s, 0.0), (0.0, 0.0, -1.0)])
        middle = np.array([*self.size_m, 0.0]) / 2
        pose[:3, 3] = np.array([self.x_m, self.y_m, THICKNESS_M + _INK_M]) - pose[:3, :3] @ middle
        return pose


def add_board(spec: mujoco.MjSpec, board: BoardSpec) -> None:
    """Add the plate, which things can touch, and the picture on it, fixed to the table."""
    height, width = board.image.shape
    texture = spec.add_texture(
        name=PRINT_GEOM, type=mujoco.mjtTexture.mjTEXTURE_2D, width=width, height=height, nchannel=3
    )
    texture.data = np.ascontiguousarray(np.repeat(board.image[..., None], 3, axis=2)).tobytes()
    # No gloss, and one copy of the picture over the whole face
    material = spec.add_material(name=PRINT_GEOM, specular=0.0, shininess=0.0, texuniform=False, texrepeat=[1, 1])
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = PRINT_GEOM
    # MuJoCo lays a picture on a box with its right along x and its top along y
    T_base_board = board.T_base_board()
    quat = np.empty(4)
    mujoco.mju_mat2Quat(quat, (T_base_board[:3, :3] * [1.0, -1.0, -1.0]).ravel().copy())
    half_width_m, half_height_m = board.size_m[0] / 2, board.size_m[1] / 2
    common = {"quat": quat, "group": GROUP_SCENE, "type": mujoco.mjtGeom.mjGEOM_BOX}
    spec.worldbody.add_geom(
        name="board_plate",
        pos=[board.x_m, board.y_m, THICKNESS_M / 2],
        size=[half_width_m + MARGIN_M, half_height_m + MARGIN_M, THICKNESS_M / 2],
        rgba=(0.95, 0.95, 0.95, 1.0),
        contype=BIT_SCENE,
        conaffinity=BIT_SCENE | BIT_BASE | BIT_GRIPPER,
        solref=CONTACT_SOLREF,
        solimp=CONTACT_SOLIMP,
        **common,
    )
    spec.worldbody.add_geom(
        name=PRINT_GEOM,
        pos=[board.x_m, board.y_m, THICKNESS_M],
        size=[half_width_m, half_height_m, _INK_M],
        contype=0,
        conaffinity=0,
        material=PRINT_GEOM,
        **common,
    )


def project_print(board: BoardSpec, intrinsics: Intrinsics, T_base_camera: np.ndarray) -> np.ndarray:
    """Return the picture (H, W) uint8 as the camera at `T_base_camera` (4, 4) sees it, without OpenGL.

    Nothing hides it, and where it is not the value means nothing.
    """
    T_camera_board = np.linalg.inv(T_base_camera) @ board.T_base_board()
    i, n = intrinsics, _SUPERSAMPLING
    rows, columns = board.image.shape
    # Pixel centres are at whole numbers in both pictures: corners of the texture lie half a pixel outside
    texel = np.array(
        [[board.size_m[0] / columns, 0.0, 0.5 * board.size_m[0] / columns],
         [0.0, board.size_m[1] / rows, 0.5 * board.size_m[1] / rows],
         [0.0, 0.0, 1.0]]
    )  # fmt: skip
    onto_plane = i.K @ T_camera_board[:3, [0, 1, 3]]
    finer = np.array([[n, 0.0, (n - 1) / 2], [0.0, n, (n - 1) / 2], [0.0, 0.0, 1.0]])
    fine = cv2.warpPerspective(
        board.image, finer @ onto_plane @ texel, (n * i.width, n * i.height), flags=cv2.INTER_LINEAR, borderValue=(255,)
    )
    return cv2.resize(fine, (i.width, i.height), interpolation=cv2.INTER_AREA)
