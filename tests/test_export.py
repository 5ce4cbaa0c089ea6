"""One small file that computes what torch computes and says what it is."""

from __future__ import annotations

import numpy as np
import onnx
import onnxruntime
import pytest
import torch

from kiras_rl.deploy.metadata import PolicyError
from kiras_rl.deploy.policy import OnboardPolicy
from kiras_rl.export import ExportError, export_policy


@pytest.mark.parametrize("batch", [1, 7])
def test_the_file_computes_what_torch_computes(exported, batch):
    policy, metadata, path = exported
    proprio = torch.randn(batch, metadata.frame_size)
    history = torch.randn(batch, metadata.history_size)
    session = onnxruntime.InferenceSession(path)
    outputs = session.run(None, {"proprio": proprio.numpy(), "history": history.numpy()})
    with torch.no_grad():
        expected = policy(proprio, history)
    assert [output.name for output in session.get_outputs()] == ["actions", "velocity"]
    for given, wanted in zip(outputs, expected, strict=True):
        np.testing.assert_allclose(given, wanted, atol=1e-5)


def test_the_file_asks_for_no_newer_runtime_than_it_needs(exported):
    model = onnx.load(exported[2])
    assert [operators.version for operators in model.opset_import] == [13]
    assert model.ir_version == 7


def test_the_report_tells_size_and_difference(make_metadata, make_policy, tmp_path):
    metadata = make_metadata()
    report = export_policy(make_policy(metadata), metadata, tmp_path / "a.onnx", check_inputs=50)
    assert report.path == tmp_path / "a.onnx"
    assert report.size == report.path.stat().st_size < 500_000
    assert 0 < report.max_difference < 1e-4
    assert report.checked == 50


def test_one_file_is_written_and_nothing_is_printed(make_metadata, make_policy, tmp_path, capfd):
    metadata = make_metadata()
    export_policy(make_policy(metadata), metadata, tmp_path / "new" / "a.onnx")
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["a.onnx"]
    assert capfd.readouterr() == ("", "")


def test_the_metadata_come_back(exported):
    _, metadata, path = exported
    assert OnboardPolicy(path).metadata == metadata


def test_the_file_tells_nothing_of_the_machine_that_made_it(exported):
    model = onnx.load(exported[2])
    assert [entry.key for entry in model.metadata_props] == ["kiras"]
    assert not any(node.metadata_props or node.doc_string for node in model.graph.node)


def test_the_training_policy_is_left_as_it_was(make_metadata, make_policy, tmp_path):
    metadata = make_metadata()
    policy = make_policy(metadata).double().train()
    export_policy(policy, metadata, tmp_path / "a.onnx")
    assert policy.training
    assert policy.actor[0].weight.dtype == torch.float64


def test_without_estimator_the_actor_reads_the_history(make_metadata, make_policy, tmp_path):
    metadata = make_metadata()
    policy = make_policy(metadata, estimator=False)
    export_policy(policy, metadata, tmp_path / "a.onnx")
    onboard = OnboardPolicy(tmp_path / "a.onnx")
    onboard.step(np.ones(8), np.ones(8), (1, 0, 0, 0), np.ones(3), np.ones(3), "walk")
    frame, history = torch.tensor(onboard.frame)[None], torch.tensor(onboard.history).reshape(1, -1)
    with torch.no_grad():
        wanted = policy.actor(torch.cat([frame, history], dim=1))[0]
    np.testing.assert_allclose(onboard.action, wanted, atol=1e-5)
    assert onboard.velocity.tolist() == [0, 0, 0]


def test_a_large_network_is_refused_and_no_file_is_left(make_metadata, make_policy, tmp_path):
    metadata = make_metadata()
    with pytest.raises(ExportError, match="less than 500 kB is accepted"):
        export_policy(make_policy(metadata, hidden=400), metadata, tmp_path / "a.onnx")
    assert list(tmp_path.iterdir()) == []


def test_damaged_weights_are_refused_and_the_older_file_stays(make_metadata, make_policy, tmp_path):
    metadata = make_metadata()
    policy = make_policy(metadata)
    torch.nn.init.constant_(policy.actor[-1].bias, torch.nan)
    (tmp_path / "a.onnx").write_text("older")
    with pytest.raises(ExportError, match="differ by nan over 1000 random inputs"):
        export_policy(policy, metadata, tmp_path / "a.onnx")
    assert (tmp_path / "a.onnx").read_text() == "older"


def test_networks_of_other_widths_are_refused(make_metadata, make_policy, tmp_path):
    policy = make_policy(make_metadata())
    shorter = make_metadata(history_length=2)
    with pytest.raises(ExportError, match="does not take proprio 39, history 78"):
        export_policy(policy, shorter, tmp_path / "a.onnx")


def test_plain_metadata_are_checked_first(make_metadata, make_policy, tmp_path):
    metadata = make_metadata()
    plain = metadata.to_dict() | {"kp": [5.0]}
    with pytest.raises(PolicyError, match="kp holds 1 numbers for 8 joints"):
        export_policy(make_policy(metadata), plain, tmp_path / "a.onnx")
