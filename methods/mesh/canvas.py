"""Drawing of meshes by VTK, off screen through EGL, with the shading of the ground truth.

VTK's own lights cannot be set to that shading (:mod:`.datasets.ground_truth.model`: absolute cosines, clamped
color, premultiplied alpha), so the part of its fragment shader that computes them is replaced. Pixels are
not antialiased, as in the ground truth; the picture is float32. Translucent surfaces are drawn by dual depth
peeling, exact in order, whose textures have 8 bits a channel.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from vtkmodules.util.numpy_support import numpy_to_vtk, vtk_to_numpy
from vtkmodules.vtkCommonCore import VTK_FLOAT, VTK_ID_TYPE, vtkFloatArray, vtkPoints
from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkPolyData
from vtkmodules.vtkCommonMath import vtkMatrix4x4
from vtkmodules.vtkRenderingCore import vtkActor, vtkLight, vtkPolyDataMapper, vtkRenderer
from vtkmodules.vtkRenderingOpenGL2 import vtkEGLRenderWindow

from econgs_bench.datasets.camera import Camera
from econgs_bench.datasets.scene import RGB, Light
from econgs_bench.methods.interface import Refused
from econgs_bench.methods.mesh.geometry import Mesh

_MOST_PEELS = 1000
_UNSHADED = Light(ambient=1.0, diffuse=0.0, specular=0.0)
_SHADING = """
  vec3 view = normalize(-vertexVC.xyz);
  vec3 towards = headlight != 0 ? view : light;
  float cosine = dot(normalVCVSOutput, towards);
  vec3 between = view + towards;
  between /= max(length(between), 1e-6);
  float facing = abs(dot(normalVCVSOutput, between));
  if (phong != 0) { facing = max(dot(2.0 * cosine * normalVCVSOutput - towards, view), 0.0); }
  vec3 shaded = surface.rgb * (material.x + material.y * abs(cosine)) + material.z * pow(facing, material.w);
  gl_FragData[0] = vec4(clamp(shaded, 0.0, 1.0), surface.a);
"""


@dataclass(frozen=True, eq=False)
class Drawn:
    """A surface as it is to be drawn.

    Attributes:
        sheet: its geometry.
        color: before shading.
        opacity: of each crossing.
        light: None: unshaded.
    """

    sheet: Sheet
    color: RGB
    opacity: float
    light: Light | None


class Sheet:
    """A mesh in VTK.

    Args:
        mesh: with at least one triangle.
    """

    def __init__(self, mesh: Mesh) -> None:

        points, triangles, data = vtkPoints(), vtkCellArray(), vtkPolyData()
        points.SetData(numpy_to_vtk(mesh.points, deep=True))
        triangles.SetData(3, numpy_to_vtk(mesh.faces.ravel(), deep=True, array_type=VTK_ID_TYPE))
        data.SetPoints(points)
        data.SetPolys(triangles)
        data.GetPointData().SetNormals(numpy_to_vtk(mesh.normals(), deep=True))
        mapper = vtkPolyDataMapper()
        mapper.SetInputData(data)
        mapper.ScalarVisibilityOff()
        self.actor = vtkActor()
        self.actor.SetMapper(mapper)
        self.actor.GetProperty().SetInterpolationToPhong()
        shader = self.actor.GetShaderProperty()
        shader.AddFragmentShaderReplacement("//VTK::Light::Impl", True, _SHADING, False)
        self._uniforms = shader.GetFragmentCustomUniforms()
        low, high = mesh.points.min(axis=0), mesh.points.max(axis=0)
        self.corners = np.array([[(low, high)[n >> axis & 1][axis] for axis in range(3)] for n in range(8)])

    def set_up(self, drawn: Drawn, camera: Camera) -> None:
        """Give it color, opacity and light."""
        light = _UNSHADED if drawn.light is None else drawn.light
        x, y, z = np.array(light.direction or (0.0, 0.0, 1.0)) @ camera.camera_to_world[:3, :3]
        self._uniforms.SetUniform4f("surface", (*drawn.color, drawn.opacity))
        material = light.ambient, light.diffuse, light.specular, light.shininess
        self._uniforms.SetUniform4f("material", material)
        self._uniforms.SetUniformi("headlight", int(light.direction is None))
        self._uniforms.SetUniformi("phong", int(light.model == "phong"))
        self._uniforms.SetUniform3f("light", (x, -y, -z))  # VTK looks along -z, with y up
        self.actor.SetForceOpaque(drawn.opacity >= 1.0)
        self.actor.SetForceTranslucent(drawn.opacity < 1.0)


class Canvas:
    """The off-screen window of this process.

    Raises:
        Refused: there is no EGL.
    """

    def __init__(self) -> None:
        # Where there is no GPU, Mesa draws: with as many threads as everything else here.
        os.environ.setdefault("LP_NUM_THREADS", str(torch.get_num_threads()))

        self._window = vtkEGLRenderWindow()
        self._window.SetOffScreenRendering(True)
        if not self._window.SupportsOpenGL():
            raise Refused(
                "VTK cannot draw off screen: EGL does not work here; install it by: "
                "apt-get install libegl1 libgl1-mesa-dri"
            )
        self._window.SetMultiSamples(0)
        self._window.SetAlphaBitPlanes(1)
        self._renderer = vtkRenderer()
        self._renderer.SetBackground(0.0, 0.0, 0.0)
        self._renderer.SetBackgroundAlpha(0.0)
        self._renderer.AutomaticLightCreationOff()
        light = vtkLight()  # without one, VTK hands no normals to the shader
        light.SetLightTypeToHeadlight()
        self._renderer.AddLight(light)
        self._renderer.SetUseDepthPeeling(True)
        self._renderer.SetMaximumNumberOfPeels(_MOST_PEELS)
        self._renderer.SetOcclusionRatio(0.0)
        self._window.AddRenderer(self._renderer)
        self._shown: list[Any] = []
        self._size = (0, 0)

    def draw(self, surfaces: Sequence[Drawn], camera: Camera) -> NDArray[np.float32]:
        """(height, width, 4) premultiplied RGBA without a background."""
        empty = np.zeros((camera.height, camera.width, 4), np.float32)
        surfaces = [one for one in surfaces if one.opacity > 0.0]
        if not surfaces:
            return empty
        corners = np.concatenate([one.sheet.corners for one in surfaces])
        depths = (corners - camera.position) @ camera.camera_to_world[:3, 2]
        far = 1.001 * float(depths.max())
        if far <= 0.0:
            return empty
        self._aim(camera, max(0.999 * float(depths.min()), 1e-3 * far), far)
        self._show([one.sheet.actor for one in surfaces])
        for one in surfaces:
            one.sheet.set_up(one, camera)
        self._resize(camera.width, camera.height)
        self._window.Render()
        return self._pixels(camera.width, camera.height)

    def _aim(self, camera: Camera, near: float, far: float) -> None:
        """Set the projection of a camera whose pixels need be neither square nor centred."""
        _, down, forward = camera.camera_to_world[:3, :3].T
        view = self._renderer.GetActiveCamera()
        view.SetPosition(*camera.position)
        view.SetFocalPoint(*(camera.position + forward))
        view.SetViewUp(*-down)
        view.SetClippingRange(near, far)
        projection = np.zeros((4, 4))
        projection[0, 0], projection[0, 2] = (
            2.0 * camera.fx / camera.width,
            1.0 - 2.0 * camera.cx / camera.width,
        )
        projection[1, 1], projection[1, 2] = (
            2.0 * camera.fy / camera.height,
            2.0 * camera.cy / camera.height - 1.0,
        )
        projection[2, 2:] = -(far + near) / (far - near), -2.0 * far * near / (far - near)
        projection[3, 2] = -1.0
        matrix = vtkMatrix4x4()
        matrix.DeepCopy(projection.ravel().tolist())
        view.SetExplicitProjectionTransformMatrix(matrix)
        view.UseExplicitProjectionTransformMatrixOn()

    def _show(self, actors: list[Any]) -> None:
        """Have these actors in the scene; those of the last picture stay on the GPU."""
        if actors != self._shown:
            for actor in self._shown:
                if actor not in actors:
                    self._renderer.RemoveActor(actor)
            for actor in actors:
                self._renderer.AddActor(actor)  # which is there already stays
            self._shown = actors

    def _resize(self, width: int, height: int) -> None:
        if self._size == (width, height):
            return

        self._window.SetSize(width, height)
        self._window.Render()  # makes the buffers of this size, of 8 bits a channel
        buffers = self._window.GetRenderFramebuffer()
        buffers.PopulateFramebuffer(width, height, True, 1, VTK_FLOAT, True, 24, 0, False)
        self._window.Render()  # the first picture in a new buffer stays blank
        self._size = width, height

    def _pixels(self, width: int, height: int) -> NDArray[np.float32]:

        pixels = vtkFloatArray()
        self._window.GetRGBAPixelData(0, 0, width - 1, height - 1, 0, pixels)
        return np.ascontiguousarray(vtk_to_numpy(pixels).reshape(height, width, 4)[::-1])


@cache
def canvas() -> Canvas:
    """The canvas of this process, made when it is first used.

    Raises:
        Refused: there is no EGL.
    """
    return Canvas()
