"""One ONNX file from a trained policy, checked against torch before it is written."""

from __future__ import annotations

import copy
import logging
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import nn

from kiras_rl.deploy.errors import PlainError
from kiras_rl.deploy.metadata import METADATA_KEY, PolicyMetadata
from kiras_rl.files import replacing

if TYPE_CHECKING:
    import onnx

MAX_BYTES = 500_000  # what an onboard computer copies and loads in no time; our networks need half
MAX_DIFFERENCE = 1e-4  # between torch and onnxruntime, in units of the action
_OPSET = 18  # of the exporter
_LEAST_OPSET = 13  # which onnxruntime runs from version 1.6 on


class ExportError(PlainError, ValueError):
    """A policy that cannot be exported; the message says why."""


@dataclass(frozen=True)
class ExportReport:
    """What was written: file, bytes, largest difference to torch over the checked inputs."""

    path: Path
    size: int
    max_difference: float
    checked: int


def export_policy(
    policy: nn.Module,
    metadata: PolicyMetadata | Mapping[str, Any],
    path: str | PathLike[str],
    check_inputs: int = 1000,
) -> ExportReport:
    """Write a policy as one ONNX file that carries its own description.

    The file appears only when it is complete and agrees with torch; an older file of that name
    stays until then.

    Args:
        policy: Module, proprio (N, P), history (N, H*P) -> actions (N, J), velocity (N, 3).
        metadata: Description of the policy; a mapping is checked first.
        path: File to write.
        check_inputs: How many random inputs torch and onnxruntime have to agree on.

    Raises:
        ExportError: If networks and metadata do not fit, the file is too large, or they disagree.
        PolicyError: If the metadata are incomplete or do not fit each other.
    """
    if not isinstance(metadata, PolicyMetadata):
        metadata = PolicyMetadata.from_dict(metadata)
    policy = copy.deepcopy(policy).cpu().float().eval()
    _check_widths(policy, metadata)
    data = _serialize(policy, metadata)
    difference = _largest_difference(policy, data, metadata, check_inputs)
    if not difference <= MAX_DIFFERENCE:  # also true for NaN
        raise ExportError(
            f"onnxruntime and torch differ by {difference:.3g} over {check_inputs} random inputs; "
            f"at most {MAX_DIFFERENCE:g} is accepted"
        )
    path = Path(path)
    with replacing(path) as temporary:
        temporary.write_bytes(data)
    return ExportReport(path, len(data), difference, check_inputs)


def describe_again(source: Path, metadata: PolicyMetadata, path: Path) -> None:
    """Write a policy file with the same networks and another description.

    Args:
        source: The policy file.
        metadata: The description.
        path: File to write; it may be the same.
    """
    import onnx

    model = onnx.load(source)
    (entry,) = [entry for entry in model.metadata_props if entry.key == METADATA_KEY]
    entry.value = metadata.to_json()
    with replacing(path) as temporary:
        temporary.write_bytes(model.SerializeToString())


def _check_widths(policy: nn.Module, metadata: PolicyMetadata) -> None:
    sizes = f"proprio {metadata.frame_size}, history {metadata.history_size}"
    try:
        with torch.no_grad():
            actions, velocity = policy(*_example(metadata))
    except RuntimeError as error:
        raise ExportError(f"the policy does not take {sizes} as in its metadata: {error}") from None
    given = (actions.shape[-1], velocity.shape[-1])
    if given != (metadata.num_joints, 3):
        raise ExportError(
            f"the policy returns {given[0]} actions and {given[1]} velocities; "
            f"its metadata ask for {metadata.num_joints} and 3"
        )


def _example(metadata: PolicyMetadata, count: int = 2) -> tuple[torch.Tensor, torch.Tensor]:
    """Return zero inputs; not a batch of one, which the tracer would take for a constant."""
    return torch.zeros(count, metadata.frame_size), torch.zeros(count, metadata.history_size)


def _serialize(policy: nn.Module, metadata: PolicyMetadata) -> bytes:
    model = _trace(policy, metadata)
    _strip_debug_information(model)
    _lower_versions(model)
    entry = model.metadata_props.add()
    entry.key, entry.value = METADATA_KEY, metadata.to_json()
    data = model.SerializeToString()
    if len(data) >= MAX_BYTES:
        raise ExportError(
            f"the file would have {len(data) / 1e3:.0f} kB; less than {MAX_BYTES / 1e3:.0f} kB is "
            "accepted: make the hidden layers of the actor or of the estimator smaller"
        )
    return data


def _trace(policy: nn.Module, metadata: PolicyMetadata) -> onnx.ModelProto:
    batch = torch.export.Dim("batch")
    with _quiet():
        program = torch.onnx.export(
            policy,
            _example(metadata),
            dynamo=True,
            input_names=["proprio", "history"],
            output_names=["actions", "velocity"],
            dynamic_shapes={"proprio": {0: batch}, "history": {0: batch}},
            opset_version=_OPSET,
            verbose=False,
        )
    if program is None:  # only with the older exporter, which dynamo=True rules out
        raise ExportError("torch.onnx.export returned no model")
    return program.model_proto


@contextmanager
def _quiet() -> Iterator[None]:
    """Silence the exporter: its remarks on its own internals are not about our networks."""
    logger = logging.getLogger("torch.onnx")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logger.setLevel(level)


def _strip_debug_information(model: onnx.ModelProto) -> None:
    """Remove stack traces and source paths of the machine that exported."""
    graph = model.graph
    for item in (model, graph, *graph.node, *graph.value_info, *graph.input, *graph.output):
        del item.metadata_props[:]
        item.doc_string = ""
    for tensor in graph.initializer:
        del tensor.metadata_props[:]
        tensor.doc_string = ""


def _lower_versions(model: onnx.ModelProto) -> None:
    """Ask for the lowest versions that carry the graph: a robot's onnxruntime may be an old one.

    What the operators mean is the same in all of them; the comparison with torch follows.
    """
    import onnx

    (operators,) = model.opset_import
    for version in range(_LEAST_OPSET, operators.version + 1):
        operators.version = version
        model.ir_version = onnx.helper.find_min_ir_version_for(model.opset_import)
        with suppress(onnx.checker.ValidationError, onnx.shape_inference.InferenceError):
            onnx.checker.check_model(model, full_check=True)
            return


def _largest_difference(
    policy: nn.Module, data: bytes, metadata: PolicyMetadata, count: int
) -> float:
    import onnxruntime

    generator = torch.Generator().manual_seed(0)
    proprio, history = (
        torch.randn(zeros.shape, generator=generator) for zeros in _example(metadata, count)
    )
    session = onnxruntime.InferenceSession(data, providers=["CPUExecutionProvider"])
    outputs = session.run(
        ["actions", "velocity"], {"proprio": proprio.numpy(), "history": history.numpy()}
    )
    with torch.no_grad():
        expected = policy(proprio, history)
    pairs = zip(outputs, expected, strict=True)
    differences = [(torch.from_numpy(given) - wanted).abs().max() for given, wanted in pairs]
    return torch.stack(differences).max().item()  # NaN, too, comes through this maximum
