"""Trained networks on disk: safetensors, with everything about the training in the header."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

from operators.kpconv.rangenet import WindowRecipe
from operators.kpconv.settings import CLASSES, Settings
from operators.kpconv.spheres import SphereRecipe

Recipe = SphereRecipe | WindowRecipe

KEY = "retracer"  # entry of the file's metadata
FORMAT = 1


class WeightsError(ValueError):
    """A file that holds no network, or another one than its header says."""


class Header(msgspec.Struct, forbid_unknown_fields=True):
    """What is known of a trained network."""

    settings: Settings
    classes: tuple[str, ...] = CLASSES
    sessions: list[str] = []
    held_out: list[str] = []
    training: dict[
        str, Any
    ] = {}  # steps, batch, seed, schedule, budget...: `retracer train` with these gives the same weights
    metrics: dict[str, Any] = {}
    versions: dict[str, str] = {}
    format: int = FORMAT


def recipe_of(settings: Settings) -> Recipe:
    """Return what makes and feeds the network of these settings."""
    return SphereRecipe(settings) if settings.network == "kpconv" else WindowRecipe(settings)


def halved(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """Return the matrices in float16, half as large; biases and what batch norms keep stay as they are."""
    return {name: tensor.half() if tensor.ndim > 1 else tensor for name, tensor in tensors.items()}


def save(path: Path, tensors: dict[str, Tensor], header: msgspec.Struct) -> None:
    """Write tensors and their header; the old file stays until the new one is whole."""
    part = path.with_name(path.name + ".part")
    own = {name: tensor.detach().cpu().contiguous().clone() for name, tensor in tensors.items()}
    save_file(own, part, {KEY: msgspec.json.encode(header).decode()})
    part.replace(path)


def read(path: Path, kind: type[Any]) -> tuple[dict[str, Tensor], Any]:
    """Read tensors and their header. Raises WeightsError, in one sentence, for a file that is no such thing."""
    try:
        with safe_open(path, "pt") as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except FileNotFoundError:
        raise WeightsError(f"{path}: no such file; `retracer train SESSION... -o {path}` makes one") from None
    except (SafetensorError, OSError) as error:
        raise WeightsError(f"{path} is no safetensors file: {error}") from None
    if KEY not in metadata:
        raise WeightsError(
            f"{path} is a safetensors file, but not of `retracer train`: its metadata has no {KEY!r} entry"
        )
    try:
        return tensors, msgspec.json.decode(metadata[KEY], type=kind)
    except (msgspec.ValidationError, msgspec.DecodeError) as error:
        raise WeightsError(f"{path}: its header does not fit this version of retracer: {error}") from None


def fill(network: nn.Module, tensors: dict[str, Tensor], source: object) -> None:
    """Load tensors into a network. Raises WeightsError that names the first entry which differs."""
    wanted = network.state_dict()
    for name, tensor in wanted.items():
        shape = tuple(tensor.shape)
        if name not in tensors:
            raise WeightsError(f"{source}: the network wants {name} {shape}; the file has no such entry")
        if tuple(tensors[name].shape) != shape:
            raise WeightsError(f"{source}: {name} is {tuple(tensors[name].shape)}; the network wants {shape}")
    if unknown := [name for name in tensors if name not in wanted]:
        raise WeightsError(
            f"{source}: the file has {unknown[0]} {tuple(tensors[unknown[0]].shape)}; the network does not"
        )
    network.load_state_dict(tensors)


def load(path: Path) -> tuple[nn.Module, Header]:
    """Read a trained network, in evaluation mode, and its header. Raises WeightsError by name of what is wrong."""
    tensors, header = read(path, Header)
    if header.classes != CLASSES:
        raise WeightsError(f"{path} predicts {', '.join(header.classes)}; wanted are {', '.join(CLASSES)}")
    with torch.random.fork_rng(devices=[]):
        network = recipe_of(header.settings).network()
    fill(network, tensors, path)
    return network.eval(), header
