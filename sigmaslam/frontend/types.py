"""What passes between the front-end and the tracker."""

from dataclasses import dataclass, field, replace
from typing import Protocol, Self

import numpy as np

from sigmaslam.errors import FrameError
from sigmaslam.estimation.acceptance import ACCEPTANCE
from sigmaslam.geometry.image_cells import pixels_in
from sigmaslam.table import Table


@dataclass(frozen=True, slots=True)
class Features(Table):
    """Keypoints of one image, best first.

    Attributes:
        keypoints: (N, 2) float32 pixel coordinates (u, v).
        descriptors: (N, D) float32 of unit length; their dot product is the similarity. D = 0 for trackers without.
        scores: (N,) float32, larger is better.
        sigma: (N,) float32 standard deviation of a keypoint's place per axis, pixels.
    """

    keypoints: np.ndarray
    descriptors: np.ndarray
    scores: np.ndarray
    sigma: np.ndarray


@dataclass(frozen=True, slots=True)
class StereoView:
    """One rectified stereo pair with what was found in it.

    Attributes:
        left, right: (H, W) uint8.
        features: of the left image.
        disparity: (N,) float64 in pixels, NaN where the keypoint was not found in the right image.
        disparity_sigma: (N,) its standard deviation, NaN likewise.
        slope: (N, 2) gradient of the disparity around each keypoint, zero where unknown; of keyframes, None of others.
        behind: (K,) disparities of keypoints that were found in the right image where only the eyes swapped would have
            them, far behind infinity; the keypoints have none.
        infinity: disparity of what is infinitely far, as far as it is known to be less than zero.
        small: the left image in smaller sizes, where the front-end needs them to follow its keypoints.
        usable: (H, W) bool, pixels of the left image that landmarks may be found at; None: all.
        is_blurred: motion has blurred the left image; of a frame, not known to the front-end.
    """

    left: np.ndarray
    right: np.ndarray
    features: Features
    disparity: np.ndarray
    disparity_sigma: np.ndarray
    slope: np.ndarray | None = None
    behind: np.ndarray = field(default_factory=lambda: np.zeros(0))
    infinity: float = 0.0
    small: tuple[np.ndarray, ...] = ()
    usable: np.ndarray | None = None
    is_blurred: bool = False

    def within(self, usable: np.ndarray | None) -> Self:
        """The view with the features of usable pixels (H, W) bool alone."""
        if usable is None:
            return self
        kept = pixels_in(usable, self.features.keypoints)
        disparity, sigma = self.disparity[kept], self.disparity_sigma[kept]
        features = self.features.select(kept)
        return replace(self, features=features, disparity=disparity, disparity_sigma=sigma, usable=usable)

    def measured(self, index: np.ndarray) -> np.ndarray:
        """(K, 3) float64 (u, v, disparity) of the features of that index or mask."""
        return np.column_stack([self.features.keypoints[index].astype(np.float64), self.disparity[index]])

    def only(self, chosen: np.ndarray) -> Self:
        """The view without the disparities of all but the chosen features (N,) bool."""
        return replace(self, disparity=np.where(chosen, self.disparity, np.nan))

    def has_stereo(self, min_points: int, min_to_judge: int) -> bool:
        """Whether enough features have a disparity, and the eyes are not swapped as of `is_swapped`."""
        return int(np.isfinite(self.disparity).sum()) >= min_points and not self.is_swapped(min_to_judge)

    def is_swapped(self, min_to_judge: int) -> bool:
        """Whether the right image looks like the left eye's: too much lies behind infinity.

        False with fewer than `min_to_judge` disparities.
        """
        found = np.r_[self.disparity[np.isfinite(self.disparity)], self.behind]
        behind = int((found < self.infinity + ACCEPTANCE.swapped_disparity).sum())
        return len(found) >= min_to_judge and behind > ACCEPTANCE.swapped_share * len(found)


@dataclass(frozen=True, slots=True)
class PatchMaps(Table):
    """How patches change from one image to another: by homographies about their centres.

    Attributes:
        A: (M, 2, 2) affine part; infinite where there is no map.
        tilt: (M, 2) perspective part, 1 / pixels: an offset o of image 0 becomes A o / (1 + tilt . o).
    """

    A: np.ndarray
    tilt: np.ndarray


@dataclass(frozen=True, slots=True)
class KeypointSearch:
    """Keypoints of a keyframe that are to be found in another view.

    Attributes:
        key: the keyframe.
        index: (K,) which of its keypoints.
        predicted: (K, 2) where they are expected, pixels.
        covariance: (K, 2, 2) of that, pixels squared: only the 99 % ellipse is searched; None: the prediction is worth
            little.
        maps: of the K patches, by which they are warped before they are compared.
        disparity: (K,) expected in the view, pixels.
    """

    key: StereoView
    index: np.ndarray
    predicted: np.ndarray
    covariance: np.ndarray | None = None
    maps: PatchMaps | None = None
    disparity: np.ndarray | None = None

    @classmethod
    def anywhere(cls, key: StereoView, index: np.ndarray) -> Self:
        """Keypoints that may be anywhere in the view."""
        return cls(key, index, key.features.keypoints[index].astype(np.float64))

    def widened(self, factor: float) -> Self:
        """The same search, of predictions with so many times the covariance."""
        return self if self.covariance is None else replace(self, covariance=factor * self.covariance)


@dataclass(frozen=True, slots=True)
class TemporalMatches(Table):
    """Where keypoints of a keyframe are in the current view.

    Attributes:
        key_index: (M,) index into the keyframe's features, each at most once.
        points: (M, 2) float64 pixel coordinates in the current left image.
        disparity: (M,) float64 there, NaN where unknown.
        covariance: (M, 2, 2) of the points given the keypoints, pixels squared.
        disparity_sigma: (M,) standard deviation of the disparity, NaN where it is unknown.
        probability: (M,) that the match is right.
    """

    key_index: np.ndarray
    points: np.ndarray
    disparity: np.ndarray
    covariance: np.ndarray
    disparity_sigma: np.ndarray
    probability: np.ndarray

    @property
    def measured(self) -> np.ndarray:
        """(M, 3) (u, v, disparity)."""
        return np.column_stack([self.points, self.disparity])

    def within(self, usable: np.ndarray | None) -> Self:
        """Those at usable pixels (H, W) bool alone."""
        return self if usable is None else self.select(pixels_in(usable, self.points))


@dataclass(frozen=True, slots=True)
class Refinement:
    """Matches moved to where their patches agree.

    Attributes:
        start, places: (M, 2) float64 in image 1, as detected and refined, pixels; the same where it failed.
        moved: (M,) bool, whether it succeeded.
        A: (M, 2, 2), affine map of image 0 to image 1 around each match by which its patch was warped, infinite where
            there is none; None: patches were only shifted, or nearly.
        distance: (M,) pixels from where the neighbours' map would have the detected match; None likewise.
    """

    start: np.ndarray
    places: np.ndarray
    moved: np.ndarray
    A: np.ndarray | None = None
    distance: np.ndarray | None = None


def check_grey(image: np.ndarray, name: str) -> None:
    """Refuses what is no (H, W) uint8 array, in constant time.

    Raises:
        FrameError: names the image and what was given.
    """
    if not isinstance(image, np.ndarray):
        raise FrameError(
            f"{name} is {type(image).__name__} and no array: give a grey (H, W) uint8 image, such as "
            "cv2.imread(path, cv2.IMREAD_GRAYSCALE) returns"
        )
    if image.ndim != 2 or image.dtype != np.uint8:
        mend = "; colours go by cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)" if image.ndim == 3 else ""
        mend = "; take image[:, :, 0]" if image.ndim == 3 and image.shape[2] == 1 else mend
        mend += "" if image.dtype == np.uint8 else "; scale the values to 0 to 255 and use image.astype(np.uint8)"
        raise FrameError(f"{name} is {image.dtype} of shape {image.shape}: give a grey (H, W) uint8 image{mend}")


class Frontend(Protocol):
    """Turns images into correspondences; the tracker knows nothing else of them."""

    name: str

    def observe(self, left: np.ndarray, right: np.ndarray) -> StereoView:
        """Detects keypoints in a rectified pair and finds their disparity."""
        ...

    def match(self, search: KeypointSearch, view: StereoView) -> TemporalMatches:
        """Finds keypoints of a keyframe in the current view."""
        ...

    def follow(
        self, searches: list[KeypointSearch], starts: list[np.ndarray], left: np.ndarray, right: np.ndarray
    ) -> list[TemporalMatches]:
        """Finds keypoints of keyframes in a pair of which no features are known.

        Args:
            searches: by keyframe, with a prediction and its covariance, maps and disparities.
            starts: (K, 2) of each, where optical flow took the keypoints; NaN where that is not known.
            left, right: (H, W) uint8, the rectified pair.
        """
        ...
