"""`sigmaslam images denoise`."""

from pathlib import Path
from typing import Annotated

import typer

from sigmaslam.cli.track import InputFormat
from sigmaslam.errors import InputError
from sigmaslam.readers import open_sequence


def denoise(
    source: Annotated[
        Path, typer.Argument(metavar="INPUT", help="Image, folder of images, video, or stereo sequence with --stereo.")
    ],
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
    stereo: Annotated[
        bool, typer.Option("--stereo", help="INPUT is a stereo sequence; writes one that `track` reads.")
    ] = False,
    format: Annotated[InputFormat, typer.Option(help="With --stereo: kind of input.")] = InputFormat["auto"],
    calibration: Annotated[
        Path | None, typer.Option(help="With --stereo: calibration instead of the input's own.")
    ] = None,
) -> None:
    """Filter Gaussian, shot and quantisation noise, stuck pixels and blur out of images; writes 8-bit grey PNG.

    Images of a folder or a video are a sequence, which is filtered over time: what moves is followed, what changes
    starts anew. The noise is estimated from the first image, or from each with --single.
    """
    from sigmaslam.image_filtering import NoiseModel
    from sigmaslam.runs.denoise import denoise_files, denoise_stereo

    noise = None if sigma is None and gain is None else NoiseModel(sigma or 0.0, gain or 0.0)
    if not stereo:
        if calibration is not None or format.value != "auto":
            raise InputError("--calibration and --format go with --stereo: add it, or leave them out")
        if not source.exists():
            raise InputError(f"{source}: no such file or folder")
        if blur and thorough:
            raise InputError("--thorough does not go with --blur: leave one of them out")
        summary = denoise_files(source, out, noise, single, thorough, blur)
    else:
        if single or thorough or blur:
            raise InputError("--single, --thorough and --blur go with images, not with --stereo: leave them out")
        summary = denoise_stereo(open_sequence(source, format.value, calibration), out, noise)
    typer.echo(f"{summary.describe()}\nImages: {out}")
