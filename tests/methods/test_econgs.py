"""ECoNGS on a tiny scene of known Gaussians: what is learned, stored, edited, composed and refused."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from econgs_bench.datasets import scratch
from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.scene import Light
from econgs_bench.econgs.anchors.colors import offset_colors
from econgs_bench.methods.econgs import model as econgs_model
from econgs_bench.methods.econgs.memory import group_bytes
from econgs_bench.methods.econgs.model import Group
from econgs_bench.methods.econgs.spec import EcongsOptions
from econgs_bench.methods.econgs.training import Trainer
from econgs_bench.methods.interface import Edit, HasAttributes, HasDecoders, Refused, SceneInput
from tests.methods.conftest import Fits

fit = Fits("econgs", features=16, hidden=24, embedding=8, offsets=4, voxel=0.01, rate_weight=1e-3)
options = fit.options


def pictures(model, scene, **keywords):
    return torch.stack([model.render(camera, **keywords)[0] for camera in scene.validation.cameras])


@pytest.fixture(scope="module")
def fitted(tiny, scene):
    """Two scenes learned together (the second with its views' colors swapped) through both stages."""
    other = tiny.renamed(scene, "swapped")
    images = other.train.images[..., [2, 1, 0, 3]]
    other = replace(other, train=replace(other.train, images=images))
    recorder = tiny.Recorder()
    return fit([scene, other], recorder, 700), recorder


def test_a_fit_approaches_the_truth(tiny, scene, fitted):
    model, recorder = fitted
    assert tiny.psnr(model, scene.validation, scenes=["tiny"]) > 22.0  # a white picture: 12
    assert np.mean(recorder.losses[-50:]) < 0.5 * np.mean(recorder.losses[:50])
    assert recorder.stages[0] == "warm-up"
    assert recorder.stages[-2:] == ["context model", "rounding"]


def test_scenes_of_a_group_keep_their_own_colors(scene, fitted):
    model, _ = fitted
    own, others = [], []
    for i, camera in enumerate(scene.validation.cameras):
        truth = torch.from_numpy(scene.validation.composited(i))
        for name, mine, theirs in (("tiny", truth, truth.flip(-1)), ("swapped", truth.flip(-1), truth)):
            rgb = model.render(camera, [name])[0]
            own.append(float((rgb - mine).abs().mean()))
            others.append(float((rgb - theirs).abs().mean()))
    assert all(a < b for a, b in zip(own, others, strict=True))


def test_the_ledger_names_scenes_and_parts(tmp_path, fitted):
    ledger = fitted[0].save(tmp_path)
    assert set(ledger) == {"", "tiny", "swapped"}
    assert {"positions", "features", "scalings", "offsets"} <= set(ledger["tiny"])


def test_edits_change_what_they_name(scene, fitted):
    model, _ = fitted
    camera = scene.validation.cameras[0]
    plain, alpha = model.render(camera, ["tiny"])
    covered = alpha > 0.5

    def edited(**changes):
        return model.render(camera, ["tiny"], edit={"tiny": Edit(**changes)})

    palette = model.scene("tiny").palette
    redder = tuple((palette + torch.tensor([0.4, -0.2, -0.2])).clamp(0, 1).tolist())
    recolored = edited(palette=redder)
    assert torch.equal(recolored[1], alpha)
    assert (recolored[0] - plain)[covered].abs().mean() > 0.02
    assert edited(opacity=0.3)[1].sum() < 0.7 * alpha.sum()
    assert torch.equal(edited(light="headlight")[0], plain)
    darker = edited(ambient=0.0, diffuse=0.0, specular=0.0)[0]
    torch.testing.assert_close(darker, (1.0 - alpha)[..., None].expand(-1, -1, 3), atol=1e-4, rtol=0)


def test_offset_colors_are_kept_small_and_in_range(tiny, scene):
    """Otherwise an offset cancels what a highlight adds, for this palette color alone."""

    def colors(weight):
        trainer = Trainer([scene], options(color_weight=weight), 120, 0, "cpu")
        parts = [trainer.step() for _ in range(120)]
        assert ("color" in parts[-1]) == (weight > 0)
        state = trainer.scenes[0]
        eye = torch.tensor(scene.train.cameras[0].position, dtype=torch.float32)
        values = trainer.attributes(state.anchors)
        embedding = trainer.optimiser[f"{state.key}/embedding"]
        palette = trainer.optimiser[f"{state.key}/palette"]
        given = (state.anchors.positions, values.features, embedding, eye)
        offsets = offset_colors(trainer.decoders, *given).detach()
        base = palette.detach()[:, None] + offsets
        return float(offsets.square().mean()), float((base - base.clamp(0, 1)).abs().max())

    (free, beyond), (small, inside) = colors(0.0), colors(1.0)
    assert small < 0.5 * free
    assert inside <= beyond


def test_what_has_the_color_of_the_background_is_learned_too(scene):
    """Without a loss of alpha all of it vanishes: it starts too dark, and the empty picture is right."""
    images = scene.train.images.copy()
    images[..., :3] = images[..., 3:]  # white, over white
    white = replace(scene, train=replace(scene.train, images=images))

    def missing(weight):
        trainer = Trainer([white], options(alpha_weight=weight), 150, 0, "cpu")
        parts = [trainer.step() for _ in range(150)]
        assert ("alpha" in parts[-1]) == (weight > 0)
        alphas = [trainer.model().render(camera)[1] for camera in scene.train.cameras]
        truth = torch.from_numpy(images[..., 3])
        return float((truth - torch.stack(alphas)).clamp(min=0).sum() / truth.sum())

    assert missing(0.0) > 0.9
    assert missing(0.05) < 0.3
    assert missing(0.2) < 0.2


def test_opaque_pictures_have_no_alpha_to_learn(scene):
    """Their background is part of them; asking for alpha there would fill the space with it."""
    opaque = scene.train.images.copy()
    opaque[..., :3] += 1 - opaque[..., 3:]
    opaque[..., 3] = 1
    given = replace(scene, train=replace(scene.train, images=opaque))
    assert "alpha" not in Trainer([given], options(alpha_weight=0.1), 20, 0, "cpu").step()


@pytest.mark.parametrize(
    ("edit", "words"),
    [
        (Edit(specular=math.nan), "specular factor"),
        (Edit(palette=(2.0, 0.0, 0.0)), "palette"),
        (Edit(light=(0.0, 0.0, 0.0)), "no direction"),
    ],
)
def test_edits_out_of_range_are_refused(scene, fitted, edit, words):
    with pytest.raises(Refused, match=words):
        fitted[0].render(scene.validation.cameras[0], edit={"tiny": edit})


def test_groups_of_several_scenes_are_composed(tiny, scene, fitted):
    both = fit.method.compose([fitted[0], fit(tiny.renamed(scene, "alone"), tiny.Recorder(), 5)])
    assert both.scenes == ("tiny", "swapped", "alone")
    one, other = (pictures(model, scene, scenes=["swapped"]) for model in (both, fitted[0]))
    assert torch.equal(one, other)


def test_near_scenes_share_a_group(tiny, scene):
    far = tiny.renamed(tiny.with_cloud(scene, scene.cloud.points + np.float32(3.0)), "far")
    near = tiny.renamed(scene, "near")
    names = [[s.name for s in g] for g in fit.method.partition([scene, far, near], options())]
    assert names == [["tiny", "near"], ["far"]]
    apart = fit.method.partition([scene, near], options(joint=False))
    assert [len(group) for group in apart] == [1, 1]


def test_a_group_whose_views_lie_in_a_file_trains_to_the_same_bytes(tiny, scene, tmp_path, monkeypatch):
    monkeypatch.setenv("BENCH_CACHE", str(tmp_path / "cache"))
    group = [scene, tiny.renamed(scene, "other")]
    monkeypatch.setattr(scratch, "LIMIT", scene.train.images.nbytes - 1)
    streamed = [
        replace(one, train=replace(one.train, images=scratch.converted(one.train.images, np.float32)))
        for one in group
    ]
    assert all(scratch.is_mapped(one.train.images) for one in streamed)
    files = []
    for name, scenes in (("memory", group), ("file", streamed)):
        (tmp_path / name).mkdir()
        fit(scenes, tiny.Recorder(), 40).save(tmp_path / name)
        files.append({file.name: file.read_bytes() for file in (tmp_path / name).iterdir()})
    assert files[0] == files[1]
    views = sum(one.train.images.nbytes for one in group)
    assert group_bytes(group, options()) - group_bytes(streamed, options()) == views


def test_groups_that_do_not_fit_into_memory_are_split_or_refused(tiny, scene):
    group = [tiny.renamed(scene, name) for name in "abcd"]
    given = options()
    one, four = group_bytes(group[:1], given), group_bytes(group, given)
    assert one < group_bytes(group[:2], given) < four
    sizes = {
        limit: [len(g) for g in fit.method.partition(group, options(group_memory_mb=limit))]
        for limit in (4 * four // 2**20, (four - 1) // 2**20)
    }
    assert list(sizes.values()) == [[4], [2, 2]]
    with pytest.raises(Refused, match=r"needs about \d+ MiB and 100 MiB"):
        fit.method.partition(group, options(group_memory_mb=100))


def test_attributes_of_some_anchors_can_be_looked_at(fitted):
    model, _ = fitted
    assert isinstance(model, HasAttributes)
    count = model.primitives("tiny")
    every, some = model.attributes("tiny", 10 * count), model.attributes("tiny", 7)
    anchors = model.scene("tiny")
    assert torch.equal(every["features"], anchors.values.features)
    assert torch.equal(every["offsets"], anchors.values.offsets.reshape(count, -1))
    assert {len(values) for values in some.values()} == {7}
    assert torch.equal(some["scalings"][[0, -1]], anchors.values.scalings[[0, -1]])


def test_memory_is_estimated_from_the_points_that_become_anchors(tiny, scene):
    rng = np.random.default_rng(0)
    crowded = tiny.with_cloud(scene, rng.uniform(-0.2, 0.2, (20_000, 3)))
    all_of_it, thinned = (
        group_bytes([crowded], options(start_spacing=spacing))
        for spacing in (0.0, EcongsOptions().start_spacing)
    )
    assert thinned < all_of_it


def test_what_cannot_be_fitted_is_refused(tiny, scene):
    empty = tiny.with_cloud(scene, np.zeros((0, 3)))
    with pytest.raises(Refused, match="empty"):
        Trainer([empty], options(), 10, 0, "cpu")
    assert Trainer([empty], options(start="random", random_points=50), 10, 0, "cpu").count > 0
    with pytest.raises(Refused, match="no initial cloud"):
        fit.method.partition([empty, scene], options())


def test_noise_leaves_no_negative_scaling(tiny, scene):
    """Scalings much smaller than the step, which noise would take below zero."""
    trainer = Trainer([scene], options(scaling_step=1.0), 60, 0, "cpu")
    values = [trainer.step() for _ in range(60)]
    assert all(math.isfinite(one["loss"]) for one in values)
    assert trainer.model().primitives() > 0


def test_a_fixed_light_is_learned_as_such(tiny, scene):
    lit = replace(scene, scene=replace(scene.scene, light=Light(direction=(0.0, 0.0, 1.0))))
    model = fit(lit, tiny.Recorder(), 30)
    assert model.scene("tiny").light == (0.0, 0.0, 1.0)


@pytest.mark.parametrize("storage", ["implicit", "partial", "explicit"])
def test_storage(tiny, scene, tmp_path, storage):
    """The paper's ablation: it learns, growth goes on, and the stream gives the same picture."""
    recorder = tiny.Recorder()
    model = fit(scene, recorder, 200, storage=storage)
    assert tiny.psnr(model, scene.validation) > 17.0
    model.save(tmp_path)
    assert torch.equal(pictures(model, scene), pictures(fit.method.load(tmp_path, "cpu"), scene))
    stored = {"implicit": 16, "partial": 16 + 3 * 4, "explicit": 16 + 10 * 4}[storage]
    assert model.scene("tiny").values.features.shape[1] == stored
    names = {name.split(".")[0] for name in model.groups[0].coded.decoders}
    assert ("normal" in names) == (storage == "implicit") == ("offset" in names)
    assert ("shading" in names) == (storage != "explicit")
    assert max(recorder.counts) > min(recorder.counts)  # it grew or pruned
    with pytest.raises(DataError, match="storage"):
        options(storage="half")


def test_what_cannot_be_drawn_is_refused_with_the_name_of_its_file(tiny, scene):
    coded = fit(scene, tiny.Recorder(), 4).groups[0].coded
    for name in ("storage", "offset_color"):
        metadata = {**coded.metadata, "decoders": {**coded.metadata["decoders"], name: "no such"}}
        with pytest.raises(DataError, match=r"^0.econgs: its networks .*'no such'"):
            Group(replace(coded, metadata=metadata), "cpu", "0.econgs")
    scenes = tuple(replace(one, scalings=-one.scalings) for one in coded.scenes)
    with pytest.raises(DataError, match=r"^0.econgs: .*a scaling that is negative"):
        Group(replace(coded, scenes=scenes), "cpu", "0.econgs")
    decoders = {name: 1e30 * np.sign(one) for name, one in coded.decoders.items()}
    with pytest.raises(DataError, match=r"^0.econgs: .*a weight of more than 1e\+06"):
        Group(replace(coded, decoders=decoders), "cpu", "0.econgs")


def test_a_minibatch_of_every_scene(tiny, scene):
    """Scenes take turns, the optimiser steps once for all, and a resumed fit is the same."""
    group = [scene, tiny.renamed(scene, "other")]
    recorder = tiny.Recorder(checkpoint_at=range(91, 97))
    whole = fit(group, recorder, 151, minibatch="scenes")
    assert sorted(recorder.checkpoints) == [92, 94, 96]  # never between the scenes of a batch
    again = fit(group, tiny.Recorder(), 151, resume=recorder.checkpoints[94], minibatch="scenes")
    assert torch.equal(pictures(whole, scene), pictures(again, scene))
    trainer = Trainer(group, options(minibatch="scenes"), 300, 0, "cpu")
    turns = [trainer.scenes[trainer.next_view()[0]].name for _ in range(6)]
    assert len(set(turns[:2])) == 2
    assert turns[:2] * 3 == turns


def test_highlights_begin_as_small_as_chosen(scene):
    """A highlight that no camera sees is never taken away, so it must not be there from the start."""

    def coefficients(start):
        trainer = Trainer([scene], options(specular_start=start), 10, 0, "cpu")
        first, bias, second, second_bias = trainer.decoders.network("shading").tensors()
        width = first.shape[1] - trainer.options.embedding
        hidden = torch.relu(bias + first[:, width:] @ trainer.optimiser["0/embedding"])
        return 5.0 * torch.sigmoid((second_bias + second @ hidden).view(7, -1)[5].detach())

    small, published = coefficients(0.5), coefficients(2.5)
    assert float(small.max()) < 0.8
    odds = small / (5.0 - small), published / (5.0 - published)
    torch.testing.assert_close(9.0 * odds[0], odds[1])  # 2.5 / 2.5 over 0.5 / 4.5


def test_networks_are_as_wide_as_the_scene_asks_for(tiny, scene):
    def widths(points, **changed):
        cloud = np.random.default_rng(0).uniform(-0.5, 0.5, (points, 3))
        wide = options(hidden=0, start_spacing=0.0, voxel=0.001, **changed)
        trainer = Trainer([tiny.with_cloud(scene, cloud)], wide, 10, 0, "cpu")
        return trainer.decoders.hidden, trainer.coding.model.config.hidden

    assert widths(300) == (25, 4)
    assert widths(2_000) == (40, 20)
    assert widths(9_000) == (50, 50)
    assert widths(300, context_hidden=12) == (25, 12)


def test_folded_embeddings_make_the_same_pictures_in_fewer_bytes(tiny, scene):
    group = [scene, tiny.renamed(scene, "second")]
    trainer = Trainer(group, options(fold_embeddings=False, decoder_precision="float32"), 60, 0, "cpu")
    trainer.run(tiny.Recorder())
    whole = trainer.model()
    trainer.options = replace(trainer.options, fold_embeddings=True)
    folded = trainer.model()
    for name in ("tiny", "second"):
        one, other = (pictures(model, scene, scenes=[name]) for model in (whole, folded))
        assert torch.allclose(one, other, atol=2e-4)
    sizes = [model.bytes_estimate() for model in (whole, folded)]
    # four first layers of 24 x 8 floats give way to one column each
    assert sizes[0] - sizes[1] > 4 * 4 * 24 * 7 * 0.9


@pytest.mark.slow
def test_an_edited_palette_looks_like_the_edited_scene(tiny):
    """Against the renderer: the picture that was never trained is nearly as good as those that were."""
    from econgs_bench.bench.jobs.scenes import camera_extent
    from econgs_bench.bench.suites.edits import edit_of
    from econgs_bench.datasets.catalogue import open_dataset
    from econgs_bench.datasets.cloud import initial_cloud
    from econgs_bench.datasets.render_views import views_of
    from econgs_bench.datasets.views import ViewRequest

    dataset = open_dataset("shells")
    train, test, blue = (
        views_of(
            dataset,
            "middle",
            ViewRequest(split, 42, 16, 96, 96, samples=1),
            edit=edit_of("middle", edit),
        )
        for split, edit in (("train", ""), ("test", ""), ("test", "palette=#2060e0"))
    )
    given = SceneInput(
        scene=dataset.scene("middle"),
        train=train,
        validation=test,
        cloud=initial_cloud(dataset, "middle", 10_000, 0),
        extent=camera_extent(train.cameras),
    )
    trainer = Trainer([given], Fits("econgs").options(), 800, 0, "cpu")
    trainer.run(tiny.Recorder())
    model = trainer.model()
    plain = tiny.psnr(model, test)
    edited = tiny.psnr(model, blue, edit=edit_of("middle", "palette=#2060e0"))
    assert plain > 30.0
    assert edited > plain - 3.0


@pytest.mark.parametrize("directed", [False, True])
def test_decoding_for_each_frame_gives_the_same_pictures(tiny, scene, tmp_path, monkeypatch, directed):
    """Networks that see no direction run once, at load, and for each frame where that is asked for."""
    fit(scene, tiny.Recorder(), 30, view_direction=directed).save(tmp_path)
    model = fit.method.load(tmp_path, "cpu")
    assert isinstance(model, HasDecoders)
    each = model.decoding_each_frame()
    assert model.decoding(["tiny"]) == ("per frame" if directed else "once")
    assert each.decoding(["tiny"]) == "per frame"
    runs = []
    plain = econgs_model.decode
    monkeypatch.setattr(econgs_model, "decode", lambda *args, **more: runs.append(1) or plain(*args, **more))
    edit = {"tiny": Edit(opacity=0.5)}
    for changes in ({}, {"edit": edit}):
        before = pictures(model, scene, **changes)
        assert len(runs) == (len(before) if directed else 0)
        runs.clear()
        assert float((pictures(each, scene, **changes) - before).abs().max()) <= 1e-5
        assert len(runs) == len(before)
        runs.clear()
    camera = scene.validation.cameras[0]
    assert (each.timings(camera)["decode"] > 0.0, each.timings(camera)["shade"]) == (True, 0.0)
    assert (model.timings(camera)["decode"] > 0.0) == directed, "the model itself stays as it is"
