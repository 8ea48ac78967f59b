"""A printed board, such as a ChArUco one, on the twin's table at an exactly known pose."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import mujoco
import numpy as np

from hal.base.errors import InvalidValueError
from hal.base.messages import Intrinsics
from hal.base.transforms import inverse
from sim_twin.model.z1_mjcf import BIT_BASE, BIT_GRIPPER, BIT_SCENE, CONTACT_SOLIMP, CONTACT_SOLREF, GROUP_SCENE

PRINT_GEOM = "board_print"
"""Name of the geom with the printed image."""
THICKNESS_M = 0.003
"""An aluminium composite plate, as boards are mounted on [m]."""
MARGIN_M = 0.008
"""White border around the print [m]."""

_INK_M = 2e-5  # height of the print above the plate, so that it is drawn in front of it
_X_M, _Y_M = (0.25, 0.70), (-0.30, 0.30)
# Per axis: bilinear interpolation takes four texels, and would alias where the image is smaller than the texture
_SUPERSAMPLING = 3


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BoardSpec:
    """Printed image, size and pose of a board.

    Raises:
        InvalidValueError: no image, or a pose that the wrist camera cannot reach.
    """

    image: np.ndarray
    """(H, W) uint8, the print upright, without border."""
    size_m: tuple[float, float]
    """Width and height of the print [m]."""
    x_m: float = 0.42
    """Middle of the image along base x [m]."""
    y_m: float = 0.0
    """The same along base y [m]."""
    yaw_deg: float = 0.0
    """Turn about the base's z axis [°]; at 0 the image's upper edge is the far one."""

    def __post_init__(self) -> None:
        image = np.array(self.image)
        if image.ndim != 2 or image.dtype != np.uint8 or not image.size:
            raise InvalidValueError(
                f"board: the image is invalid ({image.dtype} {image.shape}, allowed uint8 (H, W)). Give a grey image.",
                code="board_image",
            )
        image.setflags(write=False)
        object.__setattr__(self, "image", image)
        if not all(0.02 <= length <= 0.6 for length in self.size_m):
            raise InvalidValueError(
                f"board: size_m is out of range ({self.size_m}, allowed 0.02 to 0.6 m). Print a board that fits "
                "the table.",
                code="board_size",
            )
        for name, (low, high) in (("x_m", _X_M), ("y_m", _Y_M)):
            if not low <= getattr(self, name) <= high:
                raise InvalidValueError(
                    f"board: {name} is out of reach ({getattr(self, name)}, allowed {low:g} to {high:g} m). Move "
                    "the board.",
                    code="board_position",
                )
        if not np.isfinite(self.yaw_deg):
            raise InvalidValueError(
                f"board: yaw_deg is invalid ({self.yaw_deg}, allowed any finite angle). Give an angle in degrees.",
                code="board_yaw",
            )

    def T_base_board(self) -> np.ndarray:
        """Return the board's pose (4, 4): origin at the upper left corner, x right, y down, z into the table."""
        yaw = np.deg2rad(self.yaw_deg)
        c, s = np.cos(yaw), np.sin(yaw)
        pose = np.eye(4)
        pose[:3, :3] = np.column_stack([(s, -c, 0.0), (-c, -s, 0.0), (0.0, 0.0, -1.0)])
        middle = np.array([*self.size_m, 0.0]) / 2
        pose[:3, 3] = np.array([self.x_m, self.y_m, THICKNESS_M + _INK_M]) - pose[:3, :3] @ middle
        return pose


def add_board(spec: mujoco.MjSpec, board: BoardSpec) -> None:
    """Add the plate, which can be touched, and the print on it, fixed to the table."""
    height, width = board.image.shape
    texture = spec.add_texture(
        name=PRINT_GEOM, type=mujoco.mjtTexture.mjTEXTURE_2D, width=width, height=height, nchannel=3
    )
    texture.data = np.ascontiguousarray(np.repeat(board.image[..., None], 3, axis=2)).tobytes()
    # No gloss, and one copy of the image over the whole face
    material = spec.add_material(name=PRINT_GEOM, specular=0.0, shininess=0.0, texuniform=False, texrepeat=[1, 1])
    # MuJoCo binds textures to materials, and only those to geoms
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = PRINT_GEOM
    # MuJoCo maps a texture onto a box with its right along x and its top along y
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
    """Return the print (H, W) uint8 in the image of the camera at `T_base_camera` (4, 4), without OpenGL.

    Occlusion is ignored; pixels outside the print have no meaning.
    """
    T_camera_board = inverse(T_base_camera) @ board.T_base_board()
    i, n = intrinsics, _SUPERSAMPLING
    rows, columns = board.image.shape
    # Pixel centres are at whole numbers in both images: corners of the texture are half a pixel outside
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
