"""Sets of photographs: known warps, homographies, dense disparity, calibrated cameras."""

from itertools import combinations
from pathlib import Path

import cv2
import numpy as np

from sigmaslam.errors import InputError
from sigmaslam.geometry.se3 import se3_inverse
from sigmaslam.readers.images import read_grey as read_grey  # also imported from here
from sigmaslam.readers.images import read_image
from sigmaslam_benchmarks.matching.image_pairs import Disparity, Homography, ImagePair, Motion, resize

_WARPS = 3
_SEED = 12


def set12(folder: Path) -> list[ImagePair]:
    """The 12 photographs, each under 3 random warps that are the same in every run."""
    pairs = []
    for number in range(1, 13):
        photograph = read_grey(folder / "Set12" / f"{number:02d}.png")
        for warp in range(_WARPS):
            pairs.append(warped_pair(photograph, np.random.default_rng((_SEED, number, warp)), f"{number:02d} {warp}"))
    return pairs


def warped_pair(photograph: np.ndarray, rng: np.random.Generator, name: str) -> ImagePair:
    """Two views of an (H, W) uint8 photograph, both resampled, with different light, blur and noise.

    From the first to the second: rotation to +-40 degrees, scale e^+-0.45, shear, mild perspective, shift.
    """
    height, width = photograph.shape
    H_0_photograph = _random_warp(rng, (width, height), strength=0.25)
    H_1_0 = _random_warp(rng, (width, height), strength=1.0)
    views = [_view(photograph, H, rng) for H in (H_0_photograph, H_1_0 @ H_0_photograph)]
    return ImagePair(name, views[0], views[1], Homography(H_1_0))


def middlebury(folder: Path) -> list[ImagePair]:
    """Motorcycle (2014) and Aloe (2006)."""
    scenes = middlebury_scenes(folder)
    aloe = scenes["aloe"][2]
    aloe[find_occluded(aloe)] = np.nan
    return [_disparity_pair(name, *scene) for name, scene in scenes.items()]


def middlebury_scenes(folder: Path) -> dict[str, tuple[Path, Path, np.ndarray]]:
    """Left and right image with disparities (H, W), NaN where they are unknown and, in Motorcycle, what is occluded."""
    motorcycle, aloe = folder / "Motorcycle", folder / "aloe"
    disparity = _read_pfm(motorcycle / "disp0GT.pfm")
    occluded = read_image(motorcycle / "mask0nocc.png") != 255
    disparity[occluded | ~np.isfinite(disparity)] = np.nan
    whole = read_image(aloe / "aloeGT.png").astype(np.float64)
    whole[whole == 0] = np.nan
    return {
        "Motorcycle": (motorcycle / "im0.png", motorcycle / "im1.png", disparity),
        "aloe": (aloe / "aloeL.jpg", aloe / "aloeR.jpg", whole),
    }


def find_occluded(disparity: np.ndarray) -> np.ndarray:
    """Pixels of the left image that something nearer hides in the right one, or that leave it.

    Args:
        disparity: (H, W) of the left image, pixels, NaN where unknown.
    Returns:
        (H, W) bool.
    """
    height, width = disparity.shape
    valid = np.isfinite(disparity)
    v, u = np.nonzero(valid)
    target = np.round(u - disparity[valid]).astype(int)
    inside = (target >= 0) & (target < width)
    nearest = np.zeros((height, width))
    np.maximum.at(nearest, (v[inside], target[inside]), disparity[valid][inside])
    occluded = np.zeros(disparity.shape, bool)
    occluded[v[~inside], u[~inside]] = True
    hidden = nearest[v[inside], target[inside]] > disparity[valid][inside] + 1.0
    occluded[v[inside], u[inside]] = hidden
    return occluded


def boat(folder: Path) -> list[ImagePair]:
    """Zoom and rotation: image 1 with 2 to 6."""
    return _homographies(folder, "img{}.pgm", "H1to{}p")


def churchill(folder: Path) -> list[ImagePair]:
    """Viewpoint: image 1 with 2 to 6."""
    return _homographies(folder, "{}.ppm", "H_1_{}")


def fountain(folder: Path) -> list[ImagePair]:
    """All six pairs of the four calibrated photographs."""
    pairs = []
    for (first, (image0, K, T_world_0)), (second, (image1, _, T_world_1)) in combinations(
        fountain_views(folder).items(), 2
    ):
        motion = Motion(K, se3_inverse(T_world_1) @ T_world_0)
        pairs.append(ImagePair(f"{first} {second}", image0, image1, motion))
    return pairs


def fountain_views(folder: Path) -> dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Of the four photographs from left to right: the image, K (3, 3) and T_world_camera (4, 4)."""
    views = {}
    for number in ("0002", "0003", "0004", "0005"):
        image, S = resize(read_grey(folder / "images" / f"{number}.jpg"))
        rows = _read_numbers(folder / "gt_dense_cameras" / f"{number}.jpg.camera", 26)
        # K, distortion, R (camera to world), centre, size: x_camera = R^T (X - C).
        T_world_camera = np.eye(4)
        T_world_camera[:3, :3], T_world_camera[:3, 3] = rows[12:21].reshape(3, 3), rows[21:24]
        views[number] = image, S @ rows[:9].reshape(3, 3), T_world_camera
    return views


def _homographies(folder: Path, image_name: str, homography_name: str) -> list[ImagePair]:
    first, S0 = resize(read_grey(folder / image_name.format(1)))
    pairs = []
    for number in range(2, 7):
        other, S1 = resize(read_grey(folder / image_name.format(number)))
        H = _read_numbers(folder / homography_name.format(number), 9).reshape(3, 3)
        pairs.append(ImagePair(f"1 {number}", first, other, Homography(S1 @ H @ np.linalg.inv(S0))))
    return pairs


def _disparity_pair(name: str, left: Path, right: Path, disparity: np.ndarray) -> ImagePair:
    (image0, S0), (image1, S1) = (resize(read_grey(path)) for path in (left, right))
    return ImagePair(name, image0, image1, Disparity(disparity, S0, S1))


def _random_warp(rng: np.random.Generator, size: tuple[int, int], strength: float) -> np.ndarray:
    """Homography about the centre of an image of that (width, height)."""
    angle = np.deg2rad(40.0) * strength * rng.uniform(-1, 1)
    scale = np.exp(0.45 * strength * rng.uniform(-1, 1))
    stretch = np.exp(0.15 * strength * rng.uniform(-1, 1))
    shear = 0.2 * strength * rng.uniform(-1, 1)
    cosine, sine = np.cos(angle), np.sin(angle)
    H, to_centre, back = np.eye(3), np.eye(3), np.eye(3)
    H[:2, :2] = scale * np.array([[cosine, -sine], [sine, cosine]]) @ [[stretch, shear], [0.0, 1.0 / stretch]]
    H[2, :2] = 0.3 * strength * rng.uniform(-1, 1, 2) / size
    to_centre[:2, 2] = -0.5 * (np.array(size) - 1.0)
    back[:2, 2] = 0.5 * (np.array(size) - 1.0) + 0.1 * strength * rng.uniform(-1, 1, 2) * size
    return np.asarray(back @ H @ to_centre)


def _view(photograph: np.ndarray, H: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The photograph, mirrored at its borders, through a homography and a camera of its own."""
    height, width = photograph.shape
    # Draw at twice the size and average, so that a smaller scale does not alias.
    double = np.array([[2.0, 0.0, 0.5], [0.0, 2.0, 0.5], [0.0, 0.0, 1.0]])
    large = cv2.warpPerspective(
        photograph, double @ H, (2 * width, 2 * height), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT_101
    )
    image = cv2.resize(large, (width, height), interpolation=cv2.INTER_AREA).astype(np.float32) / 255.0
    image = np.exp(rng.uniform(-0.5, 0.1)) * image ** np.exp(rng.uniform(-0.4, 0.4))
    blur = rng.uniform(0.0, 1.2)
    if blur > 0.3:
        image = cv2.GaussianBlur(image, (0, 0), blur)
    image = image + rng.uniform(0.003, 0.03) * rng.standard_normal(image.shape, np.float32)
    return np.round(np.clip(image, 0.0, 1.0) * 255.0).astype(np.uint8)


def _read_pfm(path: Path) -> np.ndarray:
    """(H, W) float64 of a little-endian PFM; its scale is left alone, by which OpenCV would divide."""
    try:
        kind, size, scale, content = path.read_bytes().split(b"\n", 3)
        width, height = (int(number) for number in size.split())
        if kind != b"Pf" or float(scale) >= 0:
            raise ValueError("not a grey little-endian PFM")
        # Rows go from the bottom to the top.
        return np.frombuffer(content, "<f4").reshape(height, width)[::-1].astype(np.float64)
    except (OSError, ValueError) as error:
        raise InputError(f"{path} cannot be read: {error}") from None


def _read_numbers(path: Path, count: int) -> np.ndarray:
    try:
        numbers = np.array(path.read_text().split(), np.float64)
    except (OSError, ValueError) as error:
        raise InputError(f"{path} cannot be read: {error}") from None
    if len(numbers) != count:
        raise InputError(f"{path} has {len(numbers)} numbers, expected {count}")
    return numbers
