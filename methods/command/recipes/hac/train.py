"""Runs HAC's train.py up to its bitstreams, and adds what a decoder needs beside them.

Arguments are those of HAC's train.py. What comes later there is left out: its decoding, tests and metrics.
"""

from __future__ import annotations

import json
import runpy
import sys
from pathlib import Path
from typing import NoReturn

import torch
from scene import GaussianModel

SETTINGS = ("feat_dim", "n_offsets", "use_feat_bank", "n_features_per_level")
HASH_SIZES = ("log2_hashmap_size", "log2_hashmap_size_2D")
conduct_encoding = GaussianModel.conduct_encoding


def encode(model: GaussianModel, pre_path_name: str) -> NoReturn:
    """Write bitstreams and decoder.pth, and end the program; HAC calls it after its last iteration."""
    (_, anchors, batch), summary = conduct_encoding(model, pre_path_name=pre_path_name)
    print(summary, flush=True)
    weights = model.state_dict()
    networks = [name for name in weights if name.startswith("mlp_") and "deform" not in name]
    decoder = {
        "settings": {name: getattr(model, name) for name in (*SETTINGS, *HASH_SIZES)},
        "networks": {name: weights[name] for name in networks},
        "bounds": (model.x_bound_min, model.x_bound_max),
        "counts": (anchors, batch),
    }
    torch.save(decoder, str(Path(pre_path_name) / "decoder.pth"))
    sys.exit()


if __name__ == "__main__":
    views = Path(sys.argv[sys.argv.index("-s") + 1])
    split = json.loads((views / "transforms_train.json").read_text())
    split["frames"] = split["frames"][:1]  # its loader fails on a test split without views
    (views / "transforms_test.json").write_text(json.dumps(split))
    GaussianModel.conduct_encoding = encode
    runpy.run_path("train.py", run_name="__main__")
