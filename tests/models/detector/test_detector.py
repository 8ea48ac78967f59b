"""YOLOv8's inputs and outputs: the same as ultralytics' predict() in every runtime, from every kind of file."""

import sys
from collections import Counter

import numpy as np
import pytest
import torch

from hal.base.errors import InvalidValueError
from models.detector import runtimes
from models.detector.detector import Letterbox, YoloConfig, YoloModel, best_of, labels_for
from models.detector.runtimes import RUNTIMES, installed_runtimes, open_network
from models.detector.weights import CLASSES, export_to_onnx, save_detector
from models.types import Detection
from models.weights_file import WeightsError
from tests.support.detector_networks import detecting, picture, save_checkpoint, segmenting
from tests.support.errors import raises

SIZE = (256, 320)


@pytest.fixture(scope="module", autouse=True)
def cache(tmp_path_factory):
    """A separate cache, without the exports of earlier tests."""
    with pytest.MonkeyPatch.context() as patch:
        folder = tmp_path_factory.mktemp("cache")
        patch.setenv("XDG_CACHE_HOME", str(folder))
        yield folder / "z1-grasp"


@pytest.fixture(scope="module", autouse=True)
def one_thread():
    """Torch's own threads synchronise for minutes where many tests share few cores."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="module")
def network():
    return segmenting().half().float()  # rounded to half precision, so that saving changes nothing


@pytest.fixture(scope="module")
def ours(network, tmp_path_factory):
    path = tmp_path_factory.mktemp("npz") / "detector.npz"
    save_detector(path, network, CLASSES, SIZE)
    return path


@pytest.fixture(scope="module")
def checkpoint(network, tmp_path_factory):
    path = tmp_path_factory.mktemp("pt") / "checkpoint.pt"
    save_checkpoint(path, network, CLASSES, "segment")
    return path


def predict(checkpoint, image, input_hw, **options):
    """Return (labels, confidences, boxes, masks) as ultralytics' predict() gives them."""
    from ultralytics import YOLO

    (result,) = YOLO(checkpoint).predict(
        image[..., ::-1], imgsz=list(input_hw), rect=False, retina_masks=True, device="cpu", verbose=False, **options
    )
    boxes = result.boxes
    labels = [result.names[int(c)] for c in boxes.cls]
    masks = None if result.masks is None else result.masks.data.numpy().astype(bool)
    return labels, boxes.conf.numpy(), boxes.xyxy.numpy(), masks


def match(found, labels, confidences, boxes):
    """Return index pairs of the same detections; one in twenty, whose overlap is at the limit, may lack one."""
    pairs = []
    for i, d in enumerate(found):
        same = np.abs(np.array(d.box_px) - boxes).max(axis=1) < 1.01  # ours are grown to whole pixels
        same &= (np.abs(confidences - d.confidence) < 1e-3) & (np.array(labels) == d.label)
        pairs += [(i, int(j)) for j in np.flatnonzero(same)[:1]]
    assert len(pairs) >= 0.95 * max(len(found), len(labels))
    return pairs


def iou(a, b):
    return (a & b).sum() / max((a | b).sum(), 1)


@pytest.mark.integration
@pytest.mark.parametrize("shape", [SIZE, (300, 500), (500, 200), (97, 131)])
def test_boxes_and_masks_are_those_of_ultralytics(ours, checkpoint, shape):
    image = picture(*shape)
    options = {"min_confidence": 0.4, "max_iou": 0.6, "max_detections": 100, "mirrored": False}
    detector = YoloModel(YoloConfig(weights=ours, runtime="onnxruntime", **options))
    found = detector.detect(image)
    labels, confidences, boxes, masks = predict(checkpoint, image, SIZE, conf=0.4, iou=0.6, max_det=100)
    assert len(found) > 10
    pairs = match(found, labels, confidences, boxes)
    overlaps = [iou(found[i].mask, masks[j]) for i, j in pairs]
    assert np.median(overlaps) > 0.97  # of an untrained network some masks are specks
    if shape == SIZE:
        assert min(overlaps) > 0.95
    assert all(d.mask.shape == shape for d in found)


@pytest.mark.integration
def test_every_class_of_a_box_counts_as_in_ultralytics_validator(ours):
    """An untrained network gives every class a confidence nearly everywhere."""
    from ultralytics.utils.nms import non_max_suppression

    image = picture(*SIZE)
    network = open_network(ours, "onnxruntime")
    rows, _ = network.run(Letterbox.fit(SIZE, SIZE).blob(image))
    minimum = float(np.quantile(rows[4:7].min(axis=0), 0.5))
    (expected,) = non_max_suppression(torch.from_numpy(rows[None]), minimum, 0.7, multi_label=True, max_det=300, nc=3)
    options = {"min_confidence": minimum, "max_iou": 0.7, "max_detections": 300, "mirrored": False, "every_class": True}
    found = YoloModel(YoloConfig(weights=ours, runtime="onnxruntime", **options)).detect(image)
    names = [network.names[int(number)] for number in expected[:, 5]]
    boxes = expected[:, :4].numpy().clip(0, [SIZE[1], SIZE[0]] * 2)
    match(found, names, expected[:, 4].numpy(), boxes)
    at_one_place = Counter(d.box_px for d in found)
    assert at_one_place.most_common(1)[0][1] > 1


@pytest.mark.integration
def test_a_network_without_masks_gives_boxes_alone(tmp_path):
    path = tmp_path / "boxes.pt"
    save_checkpoint(path, detecting(), ("bottle", "cup", "dog"), "detect")
    image = picture(480, 640)
    config = YoloConfig(weights=path, runtime="onnxruntime", max_iou=0.7, max_detections=100, mirrored=False)
    found = YoloModel(config).detect(image)
    labels, confidences, boxes, masks = predict(path, image, (480, 640), conf=0.5, iou=0.7, max_det=100)
    assert masks is None
    assert len(found) > 5
    match(found, labels, confidences, boxes)
    assert all(d.mask is None for d in found)


@pytest.mark.integration
def test_detections_in_a_mirrored_image_are_the_mirrored_detections(ours):
    """The network alone is not symmetric: without averaging the detections differ."""
    image = picture(*SIZE)
    misses = {}
    for mirrored in (True, False):
        detector = YoloModel(YoloConfig(weights=ours, runtime="onnxruntime", mirrored=mirrored, max_detections=100))
        found, in_mirror = detector.detect(image), detector.detect(np.ascontiguousarray(image[:, ::-1]))
        assert len(found) > 5
        misses[mirrored] = sum(not any(are_mirrored(a, b) for b in in_mirror) for a in found)
    assert misses[True] == 0 < misses[False]


def are_mirrored(a, b):
    left, top, right, bottom = b.box_px
    close = np.abs(np.subtract(a.box_px, (SIZE[1] - right, top, SIZE[1] - left, bottom))).max() <= 1
    return a.label == b.label and abs(a.confidence - b.confidence) < 1e-4 and close


@pytest.mark.integration
def test_a_network_with_other_anchors_processes_the_image_alone(ours, monkeypatch):
    monkeypatch.setattr("models.detector.detector.count_anchors", lambda _: -1)
    other, once = (
        YoloModel(YoloConfig(weights=ours, runtime="onnxruntime", mirrored=mirrored)) for mirrored in (True, False)
    )
    boxes = [[d.box_px for d in detector.detect(picture(*SIZE))] for detector in (other, once)]
    assert boxes[0] == boxes[1]


@pytest.mark.integration
@pytest.mark.parametrize("runtime", RUNTIMES)
def test_every_runtime_gives_the_same_outputs(ours, network, runtime):
    opened = open_network(ours, runtime)
    assert (opened.runtime, opened.names, opened.input_hw) == (runtime, CLASSES, SIZE)
    blob = np.ascontiguousarray(picture(*SIZE).transpose(2, 0, 1)[None], np.float32) / 255
    with torch.inference_mode():
        true_rows, true_prototypes = (out[0].numpy() for out in network(torch.from_numpy(blob))[0])
    rows, prototypes = opened.run(blob)
    assert prototypes is not None
    assert rows.shape == true_rows.shape
    # With bfloat16 two of them compute with 8 bits, which changes an untrained network's large numbers.
    assert np.median(np.abs(rows[:4] - true_rows[:4])) < 3.0
    assert np.mean(np.abs(rows[4:7] - true_rows[4:7])) < 0.02
    assert np.corrcoef(prototypes.ravel(), true_prototypes.ravel())[0, 1] > 0.95


@pytest.mark.integration
@pytest.mark.parametrize("runtime", RUNTIMES)
def test_detection_repeats_bit_by_bit(ours, runtime):
    detector = YoloModel(YoloConfig(weights=ours, runtime=runtime))
    first, second = (detector.detect(picture(*SIZE)) for _ in range(2))
    assert len(first) > 3
    for a, b in zip(first, second, strict=True):
        assert (a.label, a.confidence, a.box_px) == (b.label, b.confidence, b.box_px)
        assert (a.mask == b.mask).all()


@pytest.mark.integration
def test_torch_keeps_the_configured_number_of_threads(ours):
    torch.set_num_threads(2)
    YoloModel(YoloConfig(weights=ours, runtime="torch")).detect(picture(*SIZE))
    chosen = torch.get_num_threads()
    torch.set_num_threads(1)
    assert chosen == 2


@pytest.mark.integration
def test_the_first_installed_runtime_is_used(ours, monkeypatch):
    assert installed_runtimes(ours) == RUNTIMES  # the tests' environment has them all
    assert YoloModel(YoloConfig(weights=ours)).runtime == "openvino"
    gone = {"openvino"}
    monkeypatch.setattr(runtimes, "find_spec", lambda name: None if name in gone else object())
    assert YoloModel(YoloConfig(weights=ours)).runtime == "onnxruntime"
    gone.add("onnx")  # without which ours cannot be exported
    assert YoloModel(YoloConfig(weights=ours)).runtime == "torch"
    with raises(InvalidValueError, "runtime_unavailable") as caught:
        open_network(ours, "openvino")
    assert "torch" in str(caught.value) and "--extra fast-detector" in str(caught.value)
    gone.add("ultralytics")
    with raises(InvalidValueError, "runtime_unavailable"):
        open_network(ours)


@pytest.mark.integration
def test_detections_are_sorted_by_confidence_and_limited(ours):
    detector = YoloModel(YoloConfig(weights=ours, max_detections=5))
    found = detector.detect(picture(*SIZE), min_confidence=0.1)
    assert len(found) == 5
    confidences = [d.confidence for d in found]
    assert confidences == sorted(confidences, reverse=True)
    assert all(d.confidence > 0.5 for d in detector.detect(picture(*SIZE)))


@pytest.mark.integration
def test_the_export_is_cached_for_each_weights_file(ours, cache, network, tmp_path):
    open_network(ours, "onnxruntime")
    (made,) = cache.glob(f"{ours.stem}-*.onnx")
    before = made.stat().st_mtime_ns
    open_network(ours, "openvino")
    assert made.stat().st_mtime_ns == before
    other = tmp_path / "detector.npz"
    with torch.no_grad():
        next(network.parameters()).mul_(1.5)
    save_detector(other, network, CLASSES, SIZE)
    with torch.no_grad():
        next(network.parameters()).div_(1.5)
    open_network(other, "onnxruntime")
    assert len(list(cache.glob("detector-*.onnx"))) == 2
    assert not list(cache.glob(".*"))


def test_exchanged_weights_are_rejected_despite_an_export(ours, tmp_path):
    copy = tmp_path / "detector.npz"
    copy.write_bytes(ours.read_bytes())
    copy.with_suffix(".sha256").write_text("0" * 64)
    open_network(ours, "onnxruntime")
    with raises(WeightsError, "weights_damaged"):
        open_network(copy, "onnxruntime")


@pytest.mark.integration
def test_without_a_writable_home_the_export_is_temporary(ours, monkeypatch, tmp_path):
    file = tmp_path / "file"
    file.touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(file))
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    assert export_to_onnx(ours).is_relative_to(tmp_path)


@pytest.mark.integration
@pytest.mark.parametrize("runtime", ["openvino", "onnxruntime"])
def test_an_onnx_file_of_a_user_is_read(ours, tmp_path, runtime):
    path = tmp_path / "mine.onnx"
    path.write_bytes(export_to_onnx(ours).read_bytes())
    opened = open_network(path, runtime)
    assert (opened.names, opened.input_hw) == (CLASSES, SIZE)
    with raises(InvalidValueError, "runtime_unavailable"):
        open_network(path, "torch")


@pytest.mark.integration
def test_an_openvino_folder_of_a_user_is_read(ours, tmp_path):
    import openvino

    folder = tmp_path / "mine_openvino_model"
    openvino.save_model(openvino.Core().read_model(export_to_onnx(ours)), folder / "mine.xml")
    (folder / "metadata.yaml").write_text("task: segment\nnames:\n  0: bottle\n  1: cylinder\n  2: box\n")
    assert installed_runtimes(folder / "mine.xml") == ("openvino",)
    detectors = [YoloModel(YoloConfig(weights=path)) for path in (folder, folder / "mine.xml", ours)]
    assert {detector.classes for detector in detectors} == {CLASSES}
    found = [detector.detect(picture(*SIZE)) for detector in detectors]
    assert len(found[0]) == len(found[1]) > 3
    assert found[0][0].box_px == found[1][0].box_px


@pytest.mark.integration
def test_what_ultralytics_exports_is_read(checkpoint, tmp_path):
    from ultralytics import YOLO

    copy = tmp_path / "checkpoint.pt"
    copy.write_bytes(checkpoint.read_bytes())
    exported = YOLO(copy).export(format="onnx", imgsz=list(SIZE), dynamic=True, simplify=False, opset=17, verbose=False)
    image = picture(480, 640)
    theirs = YoloModel(YoloConfig(weights=tmp_path / exported, runtime="onnxruntime")).detect(image)
    ours = YoloModel(YoloConfig(weights=copy, runtime="onnxruntime")).detect(image)
    assert len(theirs) > 3
    assert [(d.label, d.box_px) for d in theirs] == [(d.label, d.box_px) for d in ours]


def test_a_missing_file_is_named(tmp_path):
    for name in ("a.pt", "a.onnx", "a.xml", "a.npz"):
        with raises(WeightsError, "weights_missing") as caught:
            open_network(tmp_path / name)
        assert name in str(caught.value)
    assert "train_detector" in str(caught.value)


@pytest.mark.parametrize(
    ("name", "code"),
    [
        ("notes.txt", "unknown_weights"),
        ("torn.pt", "not_a_checkpoint"),
        ("torn.onnx", "unreadable_graph"),
        ("torn.xml", "unreadable_graph"),
    ],
)
def test_a_file_without_a_detector_is_rejected_in_one_line(tmp_path, name, code):
    (tmp_path / name).write_bytes(b"not a network\n" * 40)
    with raises(WeightsError, code) as caught:
        open_network(tmp_path / name)
    assert name in str(caught.value) and "\n" not in str(caught.value)


def test_a_folder_without_a_graph_is_rejected(tmp_path):
    with raises(WeightsError, "not_an_openvino_folder"):
        open_network(tmp_path)


@pytest.mark.integration
def test_a_checkpoint_of_another_task_is_rejected(tmp_path):
    from ultralytics.nn.tasks import ClassificationModel, PoseModel

    for network, task in (
        (ClassificationModel("yolov8n-cls.yaml", ch=3, nc=3, verbose=False), "classify"),
        (PoseModel("yolov8n-pose.yaml", ch=3, nc=1, data_kpt_shape=(4, 3), verbose=False), "pose"),
    ):
        save_checkpoint(tmp_path / "other.pt", network, ("a",), task)
        with raises(WeightsError, "unsupported_head"):
            open_network(tmp_path / "other.pt")


class Trap:
    """Content of a hostile checkpoint: unpickling it calls a function."""

    sprung = False

    def __reduce__(self):
        return (setattr, (Trap, "sprung", True))


def test_a_checkpoint_runs_no_code_of_its_own(tmp_path):
    torch.save({"model": Trap()}, tmp_path / "trap.pt")
    with raises(WeightsError, "not_a_checkpoint"):
        open_network(tmp_path / "trap.pt")
    assert not Trap.sprung


def save_graph(path, n_rows, names="{0: 'a', 1: 'b'}", entry=(1, 3, 64, 64)):
    """Write an ONNX file that pools an image into (1, n_rows, 4) numbers."""
    import onnx
    from onnx import TensorProto, helper

    nodes = [
        helper.make_node("ReduceMean", ["images"], ["mean"], keepdims=0),
        helper.make_node("Expand", ["mean", "shape"], ["output0"]),
    ]
    graph = helper.make_graph(
        nodes,
        "pooling",
        [helper.make_tensor_value_info("images", TensorProto.FLOAT, entry)],
        [helper.make_tensor_value_info("output0", TensorProto.FLOAT, (1, n_rows, 4))],
        [helper.make_tensor("shape", TensorProto.INT64, (3,), (1, n_rows, 4))],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    if names:
        helper.set_model_props(model, {"names": names})
    onnx.save(model, path)


@pytest.mark.parametrize("runtime", ["openvino", "onnxruntime"])
@pytest.mark.parametrize(
    ("graph", "code"),
    [
        ({"n_rows": 5}, "unsupported_output"),
        ({"n_rows": 6, "names": ""}, "no_class_names"),
        ({"n_rows": 6, "names": "bottle"}, "no_class_names"),
        ({"n_rows": 6, "entry": (1, 1, 64, 64)}, "unsupported_input"),
    ],
)
def test_a_graph_of_another_kind_is_rejected(tmp_path, runtime, graph, code):
    save_graph(tmp_path / "other.onnx", **graph)
    with raises(WeightsError, code):
        open_network(tmp_path / "other.onnx", runtime)


@pytest.mark.parametrize("runtime", ["openvino", "onnxruntime"])
def test_an_empty_image_gives_no_detections(tmp_path, runtime):
    save_graph(tmp_path / "constant.onnx", 6)
    detector = YoloModel(YoloConfig(weights=tmp_path / "constant.onnx", runtime=runtime))
    assert detector.detect(np.zeros((48, 64, 3), np.uint8)) == []


def test_an_unknown_runtime_is_rejected_with_the_known_ones(ours):
    with raises(InvalidValueError, "unknown_runtime") as caught:
        open_network(ours, "tensorrt")
    assert all(word in str(caught.value) for word in ("tensorrt", "auto", *RUNTIMES))


@pytest.mark.integration
@pytest.mark.parametrize(
    "image", [np.zeros((48, 64), np.uint8), np.zeros((48, 64, 3)), np.zeros((0, 64, 3), np.uint8)], ids=str
)
def test_an_image_of_another_kind_is_rejected(ours, image):
    with raises(InvalidValueError, "image_type"):
        YoloModel(YoloConfig(weights=ours)).detect(image)


@pytest.mark.parametrize(
    ("name", "value", "code"),
    [
        ("min_confidence", 1.0, "detector_confidence"),
        ("max_iou", 0.0, "detector_iou"),
        ("max_detections", 0, "detector_count"),
    ],
)
def test_a_value_out_of_range_is_rejected_by_name(name, value, code):
    with raises(InvalidValueError, code) as caught:
        YoloConfig(**{name: value})
    assert f"{name} is {value}" in str(caught.value) and "allowed" in str(caught.value)


def test_the_wanted_class_or_its_coco_equivalents():
    coco = ("person", "bottle", "cup", "vase")
    assert labels_for("bottle", coco) == ("bottle",)
    assert labels_for("cylinder", coco) == ("cup", "vase")
    assert labels_for("cylinder", ("cup", *CLASSES)) == ("cylinder",)
    with raises(InvalidValueError, "unknown_class"):
        labels_for("box", coco)


def test_the_most_confident_of_the_wanted_class_is_chosen():
    found = [
        Detection(label=label, confidence=confidence, box_px=(0, 0, 1, 1))
        for label, confidence in (("cup", 0.9), ("bottle", 0.6), ("bottle", 0.7))
    ]
    assert best_of(found, ("bottle",)) is found[2]
    assert best_of(found, ("bottle", "cup")) is found[0]
    assert best_of(found, ("box",)) is None


@pytest.mark.integration
def test_listing_the_runtimes_loads_no_network_library(ours):
    """`./z1 --help` and the doctor's list must stay fast."""
    import subprocess

    program = (
        "import sys; from pathlib import Path; from models.detector.runtimes import installed_runtimes; "
        "import models.detector.detector; installed_runtimes(); "
        "sys.exit(any(name in sys.modules for name in ('torch', 'openvino', 'onnxruntime', 'ultralytics')))"
    )
    assert subprocess.run([sys.executable, "-c", program], check=False).returncode == 0
