"""Images and poses as ROS 2 messages, and back."""

import numpy as np
from geometry_msgs.msg import Pose
from sensor_msgs.msg import Image

TYPES = {"mono8": np.dtype(np.uint8), "32FC1": np.dtype(np.float32)}


def image_message(image: np.ndarray) -> Image:
    """Return an image (h, w), uint8 or float32, as a message without a header."""
    encoding = next(name for name, dtype in TYPES.items() if dtype == image.dtype)
    height, width = image.shape
    return Image(height=height, width=width, encoding=encoding, step=width * image.itemsize, data=image.tobytes())


def image_of(message: Image) -> np.ndarray:
    """Return the image (h, w) of a message."""
    dtype = TYPES[message.encoding]
    return np.frombuffer(message.data, dtype).reshape(message.height, message.width)


def pose_message(pose: np.ndarray) -> Pose:
    """Return a rigid motion (4, 4) as a message."""
    turn = pose[:3, :3]
    # The largest of the four squares is computed first: the others divide by it (Shepperd, 1978).
    squares = np.array([np.trace(turn), *np.diag(turn)])
    i = int(squares.argmax())
    if i == 0:
        quaternion = np.array(
            [1 + squares[0], turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]
        )
    else:
        a, b, c = (i - 1), i % 3, (i + 1) % 3
        quaternion = np.zeros(4)
        quaternion[0] = turn[c, b] - turn[b, c]
        quaternion[1 + a] = 1 + turn[a, a] - turn[b, b] - turn[c, c]
        quaternion[1 + b], quaternion[1 + c] = turn[b, a] + turn[a, b], turn[c, a] + turn[a, c]
    quaternion /= np.linalg.norm(quaternion)
    made = Pose()
    made.position.x, made.position.y, made.position.z = map(float, pose[:3, 3])
    made.orientation.w, made.orientation.x, made.orientation.y, made.orientation.z = map(float, quaternion)
    return made
