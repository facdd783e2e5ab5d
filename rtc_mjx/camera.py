"""Pictures of a MuJoCo model from a named camera, offscreen: by OpenGL where there is one, else by casting rays.

The ray caster needs no system library: `mj_multiRay` finds what each pixel sees, numpy shades it. It draws spheres, capsules,
boxes, cylinders and planes in their own colours, with a headlight.
"""

import functools
import logging
from typing import Any, Protocol

import mujoco
import numpy as np
from jaxtyping import Float, UInt8

from rtc_mjx.errors import UsageError, quiet_destructors

Picture = UInt8[np.ndarray, "height width 3"]
SKY = np.array([0.78, 0.85, 0.92])
AMBIENT, DIFFUSE = 0.55, 0.45


class Camera(Protocol):
    """Takes pictures of one model."""

    def __call__(self, data: mujoco.MjData) -> Picture:
        """The picture of a state; `mj_forward` has been called on it."""

    def close(self) -> None:
        """Gives back what it holds; another camera may then be made."""


def camera(model: mujoco.MjModel, name: str, height: int, width: int) -> Camera:
    """A camera of the model, by OpenGL if a context can be made, else by rays (a warning says so once).

    Raises:
        UsageError: the model has no such camera; the message lists those it has.
    """
    names = [model.camera(i).name for i in range(model.ncam)]
    if name not in names:
        raise UsageError(f"--camera {name}: no such camera; there are {', '.join(names)}")
    with quiet_destructors():
        try:
            return GlCamera(model, name, height, width)
        except Exception as error:  # every platform and library fails in its own way; without OpenGL rays do
            _say_once(f"no OpenGL ({type(error).__name__}): pictures are ray-cast; MUJOCO_GL=egl or osmesa with its library is faster")
    return RayCamera(model, name, height, width)


@functools.cache
def _say_once(message: str) -> None:
    logging.getLogger("rtc_mjx").warning(message)


class GlCamera:
    """A camera by OpenGL (`mujoco.Renderer`)."""

    def __init__(self, model: mujoco.MjModel, name: str, height: int, width: int) -> None:
        if not hasattr(mujoco, "GLContext"):
            raise RuntimeError("OpenGL is turned off by MUJOCO_GL")
        self.renderer, self.name = mujoco.Renderer(model, height, width), name

    def __call__(self, data: mujoco.MjData) -> Picture:
        """The picture of a state."""
        self.renderer.update_scene(data, self.name)
        return self.renderer.render()

    def close(self) -> None:
        """Frees the context: one that is freed while another is in use takes that one's picture away."""
        self.renderer.close()


class RayCamera:
    """A camera by `mj_multiRay`; needs no OpenGL."""

    def __init__(self, model: mujoco.MjModel, name: str, height: int, width: int) -> None:
        self.model, self.index = model, model.camera(name).id
        self.shape = (height, width)
        half = np.tan(np.radians(model.cam_fovy[self.index]) / 2)
        across = (np.arange(width) + 0.5 - width / 2) * 2 * half / height
        down = (height / 2 - np.arange(height) - 0.5) * 2 * half / height
        rays = np.stack([*np.meshgrid(across, down), np.full((height, width), -1.0)], axis=-1).reshape(-1, 3)
        self.rays = rays / np.linalg.norm(rays, axis=1, keepdims=True)
        self.hidden = _textures(model)

    def __call__(self, data: mujoco.MjData) -> Picture:
        """The picture of a state."""
        count = len(self.rays)
        rays = np.ascontiguousarray(self.rays @ data.cam_xmat[self.index].reshape(3, 3).T)
        ids, distances, normals = np.full(count, -1, np.int32), np.zeros(count), np.zeros(3 * count)
        place = data.cam_xpos[self.index]
        mujoco.mj_multiRay(self.model, data, place, rays.ravel(), self._groups(), 1, -1, ids, distances, normals, count, mujoco.mjMAXVAL)
        colour = _colours(self.model)[ids]  # they may have changed since the last picture
        points = place + rays * distances[:, None]
        for geom, (first, second, size) in self.hidden.items():
            seen = ids == geom
            odd = np.floor(points[seen, :2] / size).sum(axis=1) % 2 == 1
            colour[seen] = np.where(odd[:, None], first, second)
        facing = np.abs(np.sum(normals.reshape(-1, 3) * rays, axis=1))
        shaded = np.where((ids >= 0)[:, None], colour * (AMBIENT + DIFFUSE * facing[:, None]), SKY)
        return (255 * np.clip(shaded, 0, 1)).astype(np.uint8).reshape(*self.shape, 3)

    def close(self) -> None:
        """Nothing is held."""

    def _groups(self) -> Any:
        return np.array([1, 1, 1, 0, 0, 0], np.uint8)  # what a viewer shows at first


def _colours(model: mujoco.MjModel) -> Float[np.ndarray, "geoms 3"]:
    """Colour of each geom: its material's, else its own."""
    own = model.geom_rgba[:, :3]
    if not model.nmat:
        return np.array(own, float)
    given = model.mat_rgba[np.maximum(model.geom_matid, 0), :3]
    return np.where((model.geom_matid >= 0)[:, None], given, own).astype(float)


def _textures(model: mujoco.MjModel) -> dict[int, tuple[np.ndarray, np.ndarray, float]]:
    """Geoms with a chequered material: both colours in [0, 1] and the side of a square in m."""
    out = {}
    for geom in range(model.ngeom):
        material = int(model.geom_matid[geom])
        texture = int(model.mat_texid[material][mujoco.mjtTextureRole.mjTEXROLE_RGB]) if material >= 0 else -1
        if texture < 0:
            continue
        start, width, depth = int(model.tex_adr[texture]), int(model.tex_width[texture]), int(model.tex_nchannel[texture])
        pixels = model.tex_data[start : start + width * depth].reshape(width, depth)[:, :3] / 255
        out[geom] = (pixels[width // 4], pixels[3 * width // 4], 0.5 / max(1e-6, float(model.mat_texrepeat[material][0])))
    return out
