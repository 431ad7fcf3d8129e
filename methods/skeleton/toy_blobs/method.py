"""The method: round Gaussians that stay where the initial cloud put them and learn color and opacity.

``Trainer`` fits a scene, ``Model`` renders and stores it, ``Method`` joins the two. What the harness
calls is specified in ``econgs_bench.methods.interface``. Base classes in ``econgs_bench.methods.shared`` do
most of it.
"""

from dataclasses import dataclass

import torch

from econgs_bench.econgs.anchors.gaussians import Gaussians, draw
from econgs_bench.econgs.losses import view_losses
from econgs_bench.econgs.optim import Adam
from econgs_bench.econgs.splat.composite import scale_depth
from econgs_bench.methods.interface import Refused
from econgs_bench.methods.shared.densification import Drawn
from econgs_bench.methods.shared.edits import opacity_factor
from econgs_bench.methods.shared.method import TrainerMethod
from econgs_bench.methods.shared.model import SceneModel
from econgs_bench.methods.shared.quantised_scene import QuantisedScene, half_exact, read_folder
from econgs_bench.methods.shared.training import TrainingLoop

FORMAT = "toy-blobs 1"  # name and version of the file format


def blobs(positions, values, size, opacity=1.0):
    """Round Gaussians at positions (N, 3) with values (N, 4) in [0, 1]: color and opacity."""
    quats = torch.eye(4)[:1].to(positions).repeat(len(positions), 1)
    scales = torch.full_like(positions, size)
    return Gaussians(positions, quats, scales, scale_depth(values[:, 3], opacity), values[:, :3])


class Trainer(TrainingLoop):
    """Fits one scene. The base class runs the iterations, draws views and writes checkpoints."""

    def __init__(self, scene, options, iterations, seed, device):
        super().__init__([scene], options, iterations, seed, device)
        if len(scene.cloud) == 0:
            raise Refused(f"scene {scene.name!r} has no cloud")  # a row of the tables, not a crash
        self.train, self.size, self.ssim_weight = scene.train, options.size, options.ssim_weight
        # The parameters. All randomness comes from self.generator, so that a resumed fit gives the same bits.
        self.positions = half_exact(torch.from_numpy(scene.cloud.points.copy())).to(device)
        values = torch.full((len(scene.cloud), 4), 0.1)
        values[:, :3] = torch.from_numpy(scene.cloud.colors.copy()).clamp(0.05, 0.95)
        self.optimiser = Adam({"logits": values.logit().to(device)}, {"logits": options.learning_rate})

    @property
    def count(self):
        """Number of primitives."""
        return len(self.positions)

    def stage(self):
        """Name of the present stage, for people: "warm-up", "refinement"."""
        return "colors"

    def views(self):
        return self.shuffled(len(self.train))

    def draw(self):
        """Draw a view: parts of your loss go here. The base class takes gradients and steps."""
        view = self.next_view()
        truth = torch.from_numpy(self.train.images[view]).to(self.device)  # (H, W, 4), premultiplied
        values = self.optimiser["logits"].sigmoid()
        splats = draw([blobs(self.positions, values, self.size)], self.train.cameras[view])
        drawn = splats.features, splats.alpha
        image, _ = view_losses(*drawn, truth, self.train.background, ssim_weight=self.ssim_weight)
        return Drawn(losses={"image": image})

    def checkpoint(self):
        """The base class keeps optimiser, generator and order of views; add all else that the model needs."""
        state = super().checkpoint()
        state.arrays["positions"] = self.positions
        return state

    @staticmethod
    def restored(state, options):
        """The model of a checkpoint, as it will be stored: quantise and prune here, not while saving."""
        (label,) = state.scenes
        values = half_exact(state.value("logits").sigmoid()).to(state.device)
        scene = Scene(label.name, label.background, state.arrays["positions"], values, options.size)
        return Model([scene])


@dataclass(frozen=True)
class Scene:
    """A fitted scene: positions (N, 3), values (N, 4) in [0, 1], size in scene units."""

    name: str
    background: tuple[float, float, float]
    positions: torch.Tensor
    values: torch.Tensor
    size: float

    def __len__(self):
        return len(self.positions)


class Model(SceneModel):
    """Fitted scenes. The base class renders, times and joins them by their Gaussians."""

    method = "toy-blobs"

    def gaussians(self, scene, camera, edit):
        """The Gaussians of a scene in a view. View-dependent color goes here; so do edits."""
        factor = opacity_factor(self.method, scene.name, edit)  # refuses all edits but opacity
        return blobs(scene.positions, scene.values, scene.size, factor)

    def write(self, folder):
        """Write all files that load needs; returns their bytes: scene -> part -> bytes."""
        ledger = {}
        for scene in map(self.scene, self.scenes):
            about, columns = {"size": scene.size}, {"values": scene.values}
            file = QuantisedScene(scene.name, scene.background, about, scene.positions, columns, "fixed")
            ledger[scene.name] = file.write(folder, FORMAT)
        return ledger

    @classmethod
    def load(cls, folder, device):
        """Read the files in a new process; damaged ones raise DataError (read_folder does it)."""

        def ready(file):
            values = file.column("values", 4).to(device)
            return Scene(
                file.name, file.background, file.positions.to(device), values, float(file.about["size"])
            )

        return cls(scene for _, scene in read_folder(folder, cls.method, FORMAT, {"values": 4}, ready))


class Method(TrainerMethod):
    """What the spec names: each scene is fitted on its own. A joint method has a partition of its own."""

    name, trainer, model = "toy-blobs", Trainer, Model
