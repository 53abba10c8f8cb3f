"""A network of the shape of GQ-CNN (Mahler et al., 2017): a crop of the depth image and the gripper's depth in, a quality out.

Its weights are drawn from a seed and were never trained: it does the work of such a network, and its qualities mean
nothing. What a grasp must fulfil is therefore checked by geometry.
"""

import os

import numpy as np
import onnxruntime
from onnx import TensorProto, checker, helper, numpy_helper

CROP = 32
CHANNELS, HIDDEN, POSE = 64, 1024, 16
PROVIDERS = ("CUDAExecutionProvider", "CPUExecutionProvider")


def model(seed: int) -> bytes:
    """Return the network as ONNX."""
    random = np.random.default_rng(seed)
    nodes, weights = [], []

    def layer(kind: str, source: str, name: str, shape: tuple[int, ...], relu: bool = True) -> str:
        """Add a convolution (out, in, k, k) or a dense layer (in, out) with its rectifier."""
        fan_in = int(np.prod(shape[1:])) if kind == "Conv" else shape[0]
        drawn = random.normal(0, np.sqrt(2 / fan_in), shape).astype(np.float32)
        bias = np.zeros(shape[0] if kind == "Conv" else shape[1], np.float32)
        weights.extend([numpy_helper.from_array(drawn, f"{name}_w"), numpy_helper.from_array(bias, f"{name}_b")])
        options = {"pads": [shape[2] // 2] * 4} if kind == "Conv" else {}
        nodes.append(helper.make_node(kind, [source, f"{name}_w", f"{name}_b"], [name], **options))
        if relu:
            nodes.append(helper.make_node("Relu", [name], [f"{name}_r"]))
        return f"{name}_r" if relu else name

    at = layer("Conv", "crops", "conv1", (CHANNELS, 1, 7, 7))
    at = layer("Conv", at, "conv2", (CHANNELS, CHANNELS, 5, 5))
    nodes.append(helper.make_node("MaxPool", [at], ["pool"], kernel_shape=[2, 2], strides=[2, 2]))
    at = layer("Conv", "pool", "conv3", (CHANNELS, CHANNELS, 3, 3))
    at = layer("Conv", at, "conv4", (CHANNELS, CHANNELS, 3, 3))
    nodes.append(helper.make_node("Flatten", [at], ["flat"]))
    image = layer("Gemm", "flat", "dense3", (CHANNELS * (CROP // 2) ** 2, HIDDEN))
    pose = layer("Gemm", "depths", "pose1", (1, POSE))
    nodes.append(helper.make_node("Concat", [image, pose], ["both"], axis=1))
    at = layer("Gemm", "both", "dense4", (HIDDEN + POSE, HIDDEN))
    at = layer("Gemm", at, "dense5", (HIDDEN, 2), relu=False)
    nodes.append(helper.make_node("Softmax", [at], ["qualities"], axis=1))
    graph = helper.make_graph(
        nodes,
        "grasp_quality",
        [
            helper.make_tensor_value_info("crops", TensorProto.FLOAT, ["n", 1, CROP, CROP]),
            helper.make_tensor_value_info("depths", TensorProto.FLOAT, ["n", 1]),
        ],
        [helper.make_tensor_value_info("qualities", TensorProto.FLOAT, ["n", 2])],
        weights,
    )
    made = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    checker.check_model(made)
    return made.SerializeToString()


class Network:
    """The network on the GPU if onnxruntime has its provider and there is one, else on all CPUs of this process."""

    def __init__(self, seed: int) -> None:
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = len(os.sched_getaffinity(0))
        there = onnxruntime.get_available_providers()
        providers = [name for name in PROVIDERS if name in there]
        self._session = onnxruntime.InferenceSession(model(seed), options, providers=providers)

    @property
    def provider(self) -> str:
        """What computes."""
        return str(self._session.get_providers()[0])

    def qualities(self, crops: np.ndarray, depths: np.ndarray) -> np.ndarray:
        """Return the qualities (n,) of crops (n, 32, 32) with the gripper at depths (n,), both float32."""
        given = {"crops": crops[:, None], "depths": depths[:, None]}
        return np.asarray(self._session.run(["qualities"], given)[0])[:, 1]
