"""`sigmaslam images`: single images, and points in two of them."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from sigmaslam.cli.options import Provider, Size, Weights, read_sized
from sigmaslam.errors import InputError
from sigmaslam.frontend.image_pair import DETECTORS, match_files
from sigmaslam.two_view.image_geometry import describe_files
from sigmaslam.two_view.point_tables import orient_files, triangulate_file
from sigmaslam.two_view.triangulation import METHODS

# mypy reads the members of an enum from literals alone.
Detector = StrEnum("Detector", list(DETECTORS))  # type: ignore[misc]
"""What finds and describes keypoints in a single image."""
Method = StrEnum("Method", list(METHODS))  # type: ignore[misc]
"""Ways to triangulate."""

Image0 = Annotated[Path, typer.Argument(metavar="IMAGE0", help="Image file, grey or colour, 8 or 16 bits.")]
Image1 = Annotated[Path, typer.Argument(metavar="IMAGE1", help="Another view of the scene, of any size.")]
Keypoints = Annotated[Detector, typer.Option(help="What finds and describes keypoints.")]
MaxKeypoints = Annotated[int, typer.Option(help="Most keypoints an image, at least 4.")]


def match(
    image0: Image0,
    image1: Image1,
    out: Annotated[Path, typer.Option(help="File to write, ends in .npz.")],
    frontend: Keypoints = Detector["learned"],
    max_keypoints: MaxKeypoints = 1024,
    min_probability: Annotated[
        float, typer.Option(min=0.0, max=1.0, help="Matches less probable than this are left out; 0 keeps all mutual.")
    ] = 0.5,
    picture: Annotated[
        Path | None, typer.Option(help="PNG to draw: both images, lines from purple (unlikely) to yellow (certain).")
    ] = None,
    provider: Annotated[
        Provider, typer.Option(help="Where ONNX Runtime computes the networks, if installed.")
    ] = Provider["cpu"],
    weights: Weights = None,
) -> None:
    """Match two images: which points show the same, how probably and how exactly; prints one line.

    Writes an .npz, best match first: keypoints0, keypoints1 (M, 2) pixels (u, v); probability (M,) that a match is
    right to 3 px; covariance (M, 2, 2) of keypoints1 given keypoints0; index0, index1 (M,). numpy.load reads it.
    """
    typer.echo(
        match_files(
            image0, image1, out, frontend.value, max_keypoints, min_probability, picture, provider.value, weights
        )
    )


def geometry(
    image0: Image0,
    image1: Image1,
    calibration: Annotated[
        Path | None,
        typer.Option(help="Of the pair that took the images, in any form; without it the cameras are unknown."),
    ] = None,
    eyes: Annotated[
        str, typer.Option(metavar="EYE,EYE", help="With --calibration: which of its cameras took which image.")
    ] = "left,left",
    picture: Annotated[Path | None, typer.Option(help="PNG to draw: matches, and epipolar lines of a dozen.")] = None,
    frontend: Keypoints = Detector["learned"],
    max_keypoints: MaxKeypoints = 1024,
) -> None:
    """Find how two views lie to each other: rotation and direction with sigmas; without calibration the epipoles."""
    pair = eyes.split(",")
    if len(pair) != 2:
        raise InputError(f"--eyes is {eyes!r}: give two of left and right, as left,right")
    names = (pair[0].strip(), pair[1].strip())
    typer.echo(describe_files(image0, image1, calibration, names, picture, frontend.value, max_keypoints))


def triangulate(
    pixels: Annotated[
        Path,
        typer.Argument(
            metavar="PIXELS",
            help="CSV with the columns u0,v0,u1,v1 (left, right; pixels of the raw images) and, if wanted, id and "
            "sigma; or an .npz of `match`, left image first.",
        ),
    ],
    calibration: Annotated[Path, typer.Option(help="Calibration of the pair, in any form.")],
    out: Annotated[Path, typer.Option(help="CSV to write: id,x,y,z and covariance, in the left camera, metres.")],
    method: Annotated[
        Method,
        typer.Option(help="parallel (9.34, after rectification), midpoint, linear, or the least reprojection error."),
    ] = Method["optimal"],
    size: Size = None,
    sigma: Annotated[
        float, typer.Option(min=1e-6, help="Of a pixel coordinate, where the file does not say.", metavar="PX")
    ] = 0.5,
) -> None:
    """Points of a stereo pair from pixels in both images, each with its covariance."""
    typer.echo(triangulate_file(pixels, read_sized(calibration, size), out, method.value, sigma))


def orient(
    source: Annotated[Path, typer.Argument(metavar="SOURCE", help="CSV with the columns id,x,y,z, metres.")],
    target: Annotated[
        Path, typer.Argument(metavar="TARGET", help="The same control points in the other frame; a sigma if wanted.")
    ],
    out: Annotated[Path, typer.Option(help="JSON to write: T_target_source, scale, covariance, residuals.")],
    scale: Annotated[bool, typer.Option("--scale", help="Find a scale, too.")] = False,
    sigma: Annotated[
        float | None,
        typer.Option(min=1e-12, metavar="M", help="Of a target coordinate.", show_default="from the residuals"),
    ] = None,
) -> None:
    """Find how two frames lie to each other from points known in both (absolute orientation)."""
    typer.echo(orient_files(source, target, out, scale, sigma))


def denoise(
    source: Annotated[Path, typer.Argument(metavar="INPUT", help="Image, folder of images, or video of one eye.")],
    out: Annotated[Path, typer.Option(help="Folder for the filtered images, new or empty.")],
    sigma: Annotated[
        float | None,
        typer.Option(min=0.0, max=255.0, help="Deviation of the noise, grey levels of 255.", show_default="estimated"),
    ] = None,
    gain: Annotated[
        float | None,
        typer.Option(min=0.0, max=255.0, help="Variance of shot noise per grey level: 255 / photons at white."),
    ] = None,
    blur: Annotated[
        float,
        typer.Option(
            min=0.0, max=20.0, help="Of a lens out of focus: sigma in pixels; takes it out, each image by itself."
        ),
    ] = 0.0,
    single: Annotated[
        bool, typer.Option("--single", help="Filter each image by itself: they are no sequence.")
    ] = False,
    thorough: Annotated[bool, typer.Option("--thorough", help="Better and much slower; each image by itself.")] = False,
) -> None:
    """Filter Gaussian, shot and quantisation noise, stuck pixels and blur out of images; writes 8-bit grey PNG.

    Images of a folder or a video are a sequence, each filtered with those before and after it: what moves is
    followed, what changes starts anew. The noise is estimated from the first image, or from each with --single.
    """
    from sigmaslam.image_filtering import NoiseModel
    from sigmaslam.runs.denoise import denoise_files

    if not source.exists():
        raise InputError(f"{source}: no such file or folder")
    if blur and thorough:
        raise InputError("--thorough does not go with --blur: leave one of them out")
    noise = None if sigma is None and gain is None else NoiseModel(sigma or 0.0, gain or 0.0)
    summary = denoise_files(source, out, noise, single, thorough, blur)
    typer.echo(f"{summary.describe()}\nImages: {out}")
