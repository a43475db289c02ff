"""The image size that a calibration file does not give."""

from sigmaslam.errors import CalibrationError

ImageSize = tuple[int, int]


class UnknownImageSizeError(CalibrationError):
    """A calibration file does not name the size of its images, and nothing else does."""


def need_image_size(name: str, image_size: ImageSize | None) -> ImageSize:
    """The image size that is given, (width, height).

    Raises:
        UnknownImageSizeError: none is.
    """
    if image_size is None:
        raise UnknownImageSizeError(f"{name}: does not name the size of the images; give --size WIDTHxHEIGHT")
    return image_size
