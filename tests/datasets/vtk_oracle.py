"""Volume rendering by VTK as a second opinion: the same field, transfer function, light and cameras.

Two mappers: ``gpu`` (ray casting in a fragment shader; without a GPU, Mesa runs it on the CPU) and
``cpu`` (VTK's fixed-point ray caster). As VTK comes, its pictures differ from ours in what is a choice,
or not ours to imitate:

* Frame buffers have 8 bits a channel: 59 dB at best.
* The shader stops rays at an alpha of 254/255: up to 1/255.
* Samples lie at whole steps from where a ray enters, ours in the middle of steps.
* With a light fixed in space, highlights on faces turned away from it are reflected about the wrong
normal.

``alike`` changes these in its shader, so that all the rest can be compared closely. What remains to be
minded: with a fixed light ``ambient`` is multiplied by the light's own ambient color (leave it 0) and
normals are right only in cubic boxes; weak gradients are not softened; tables are looked up half an entry
off (so they have 16384 entries); the CPU mapper shades otherwise (compare it unshaded, or its speed).

Run as a script it renders pickled jobs, so that a driver's crash stays in a process of its own.
"""

from __future__ import annotations

import math
import pickle
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from econgs_bench.datasets.camera import Camera
from econgs_bench.datasets.scene import Light
from econgs_bench.datasets.transfer import TransferFunction
from econgs_bench.datasets.volume import Volume

Mapper = Literal["gpu", "cpu"]
_TABLE = 16384
_ALIKE = {
    "g_opacityThreshold = 1.0 - 1.0 / 255.0": "g_opacityThreshold = 1.0 - 1.0e-6",
    "g_rayJitter = g_dirStep;": "g_rayJitter = 0.5 * g_dirStep;",
    "nDotL = -nDotL;": "nDotL = -nDotL; normal = -normal;",
}


class VtkRenderer:
    """One volume, transfer function and light in an off-screen window of VTK.

    Args:
        mapper: "gpu" or "cpu".
        step_voxels: distance of samples in units of ``Volume.voxel``.
        light: None renders unshaded.
        threads: of the CPU mapper.
        alike: change the four points above ("gpu").
        integers: hand the CPU mapper 16-bit values, its natural input, instead of floats.
    """

    def __init__(
        self,
        volume: Volume,
        transfer: TransferFunction,
        light: Light | None,
        *,
        mapper: Mapper = "gpu",
        step_voxels: float = 1.0,
        threads: int = 2,
        alike: bool = False,
        integers: bool = False,
    ) -> None:
        import vtk

        self._vtk = vtk
        self._box = volume.extent
        self._alike = alike
        self._prepared: tuple[int, int] | None = None
        image = _image(volume, integers)
        actor = vtk.vtkVolume()
        actor.SetMapper(self._mapper(mapper, image, step_voxels * volume.voxel, threads))
        actor.SetProperty(_property(transfer, light, 65535.0 if integers else 1.0))
        if mapper == "gpu" and alike:
            for theirs, ours in _ALIKE.items():
                actor.GetShaderProperty().AddFragmentShaderReplacement(theirs, False, ours, True)
        self._renderer = vtk.vtkRenderer()
        self._renderer.SetBackground(0.0, 0.0, 0.0)
        self._renderer.SetBackgroundAlpha(0.0)
        self._renderer.AutomaticLightCreationOff()
        self._renderer.AddLight(_light(light))
        self._renderer.AddVolume(actor)
        # Named, so that VTK does not look for an X server first.
        self.window = getattr(vtk, "vtkEGLRenderWindow", vtk.vtkRenderWindow)()
        self.window.SetOffScreenRendering(True)
        self.window.SetMultiSamples(0)
        self.window.SetAlphaBitPlanes(1)
        self.window.AddRenderer(self._renderer)

    def _mapper(self, which: Mapper, image: Any, step: float, threads: int) -> Any:
        vtk = self._vtk
        if which == "gpu":
            mapper = vtk.vtkGPUVolumeRayCastMapper()
            mapper.SetUseJittering(False)
            mapper.SetMaxMemoryInBytes(2**33)
            mapper.SetMaxMemoryFraction(1.0)
        else:
            mapper = vtk.vtkFixedPointVolumeRayCastMapper()
            mapper.SetNumberOfThreads(threads)
            mapper.SetIntermixIntersectingGeometry(False)
        mapper.SetAutoAdjustSampleDistances(False)
        mapper.SetImageSampleDistance(1.0)
        mapper.SetLockSampleDistanceToInputSpacing(False)
        mapper.SetSampleDistance(step)
        mapper.SetBlendModeToComposite()
        mapper.SetInputData(image)
        return mapper

    def draw(self, camera: Camera) -> None:
        """Render into the window, without reading it back."""
        size = camera.width, camera.height
        if self._prepared != size:
            self.window.SetSize(*size)
            self._aim(camera)
            self.window.Render()
            if self._alike:
                # The window makes its buffers, of 8 bits, with the first picture of a size.
                self.window.GetRenderFramebuffer().PopulateFramebuffer(
                    *size, True, 1, self._vtk.VTK_FLOAT, True, 24, 0, False
                )
                self.window.Render()  # a new buffer's first picture stays blank
            self._prepared = size
        self._aim(camera)
        self.window.Render()

    def render(self, camera: Camera) -> NDArray[np.float32]:
        """(height, width, 4) premultiplied RGBA without a background."""
        from vtkmodules.util.numpy_support import vtk_to_numpy

        self.draw(camera)
        pixels = self._vtk.vtkFloatArray()
        self.window.GetRGBAPixelData(0, 0, camera.width - 1, camera.height - 1, 0, pixels)
        image = vtk_to_numpy(pixels).reshape(camera.height, camera.width, 4)
        return np.ascontiguousarray(image[::-1])

    def _aim(self, camera: Camera) -> None:
        if not math.isclose(camera.fx, camera.fy):
            raise ValueError("VTK's pixels are square")
        view = self._renderer.GetActiveCamera()
        right_down_forward = camera.camera_to_world[:3, :3]
        view.SetPosition(*camera.position)
        view.SetFocalPoint(*(camera.position + right_down_forward[:, 2]))
        view.SetViewUp(*-right_down_forward[:, 1])
        view.SetViewAngle(math.degrees(2.0 * math.atan(0.5 * camera.height / camera.fy)))
        view.SetWindowCenter(1.0 - 2.0 * camera.cx / camera.width, 2.0 * camera.cy / camera.height - 1.0)
        distance = float(np.linalg.norm(camera.position))
        radius = 0.5 * float(np.linalg.norm(self._box))
        view.SetClippingRange(max(distance - 1.01 * radius, 1e-3), distance + 1.01 * radius)


Job = tuple[Volume, TransferFunction, "Light | None", tuple[Camera, ...], dict[str, Any]]
"""What to render and the options of :class:`VtkRenderer`."""


def render(jobs: Sequence[Job]) -> list[NDArray[np.float32]]:
    """(n, height, width, 4) pictures for each job, from one process of its own."""
    with tempfile.TemporaryDirectory() as folder:
        job_file, result_file = Path(folder, "jobs"), Path(folder, "pictures")
        job_file.write_bytes(pickle.dumps(list(jobs)))
        done = subprocess.run(
            [sys.executable, str(Path(__file__).resolve()), str(job_file), str(result_file)],
            capture_output=True,
            encoding="utf-8",
            timeout=600,
            check=False,
        )
        if done.returncode != 0 or not result_file.exists():
            raise RuntimeError(
                f"VTK could not render (exit status {done.returncode}); on Debian it needs libegl1 and "
                f"libgl1-mesa-dri.\n{done.stdout[-1000:]}{done.stderr[-2000:]}"
            )
        pictures: list[NDArray[np.float32]] = pickle.loads(result_file.read_bytes())
    return pictures


def _image(volume: Volume, integers: bool) -> Any:
    import vtk
    from vtkmodules.util.numpy_support import numpy_to_vtk

    values = volume.normalised().ravel()
    if integers:
        values = np.rint(values * 65535.0).astype(np.uint16)
    image = vtk.vtkImageData()
    image.SetDimensions(*volume.dims)
    image.SetSpacing(*(volume.extent / (np.array(volume.dims) - 1)))
    image.SetOrigin(*volume.box[0])
    image.GetPointData().SetScalars(numpy_to_vtk(values, deep=True))
    return image


def _property(transfer: TransferFunction, light: Light | None, top: float) -> Any:
    import vtk

    classified = transfer.classify(np.linspace(0.0, 1.0, _TABLE))
    opacity = -np.expm1(-classified[:, 3] * transfer.reference_length)
    colors = vtk.vtkColorTransferFunction()
    colors.BuildFunctionFromTable(0.0, top, _TABLE, classified[:, :3].ravel())
    opacities = vtk.vtkPiecewiseFunction()
    opacities.BuildFunctionFromTable(0.0, top, _TABLE, opacity, 1)
    result = vtk.vtkVolumeProperty()
    result.SetColor(colors)
    result.SetScalarOpacity(opacities)
    result.SetScalarOpacityUnitDistance(transfer.reference_length)
    result.SetInterpolationTypeToLinear()
    result.DisableGradientOpacityOn()
    if light is not None:
        result.ShadeOn()
        result.SetAmbient(light.ambient)
        result.SetDiffuse(light.diffuse)
        result.SetSpecular(light.specular)
        result.SetSpecularPower(light.shininess)
    return result


def _light(light: Light | None) -> Any:
    import vtk

    result = vtk.vtkLight()
    if light is None or light.direction is None:
        result.SetLightTypeToHeadlight()
    else:
        result.SetLightTypeToSceneLight()
        result.PositionalOff()
        result.SetPosition(*light.direction)
        result.SetFocalPoint(0.0, 0.0, 0.0)
    return result


def _main(job_file: str, result_file: str) -> None:
    pictures = []
    for volume, transfer, light, cameras, options in pickle.loads(Path(job_file).read_bytes()):
        renderer = VtkRenderer(volume, transfer, light, **options)
        pictures.append(np.stack([renderer.render(camera) for camera in cameras]))
    Path(result_file).write_bytes(pickle.dumps(pictures))


if __name__ == "__main__":
    _main(*sys.argv[1:])
