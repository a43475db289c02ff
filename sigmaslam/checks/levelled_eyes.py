"""The right camera as the matches have it: turned, moved or enlarged until both eyes see a place in the same row."""

from dataclasses import dataclass, field, replace

import cv2
import numpy as np

from sigmaslam.checks.eye_matches import EyeMatches
from sigmaslam.checks.hypotheses import rectified_places, stored_places
from sigmaslam.checks.row_fit import MIN_MATCHES, SIGNIFICANT, RowFit, fit_rows, misfit
from sigmaslam.errors import CalibrationError
from sigmaslam.frontend.row_search import ROW_TOLERANCE
from sigmaslam.geometry.camera import StereoCamera
from sigmaslam.geometry.rectification import StereoRectifier
from sigmaslam.geometry.se3 import rigid_motion

WARN_ROWS = 0.5 * ROW_TOLERANCE
"""The tracker searches rows within ROW_TOLERANCE: further off, an error; from half of it on, a warning."""
# Standard deviations.
_CREDIBLE = 4.0
# The fit is of first order: of a turn by five degrees a hundredth of a pixel is left after so many.
_ROUNDS = 4
# So many of the matches must lie in one row then.
_LEVEL = 0.5


@dataclass(frozen=True, slots=True)
class LevelledEyes:
    """A rig whose rows agree.

    Attributes:
        rectifier: of the corrected pair.
        matches: in its images.
        fit: of what is left.
        causes: of `RowFit.unit`, what was corrected, by how many pixels in all; empty where nothing was.
    """

    rectifier: StereoRectifier
    matches: EyeMatches
    fit: RowFit
    causes: dict[str, float] = field(default_factory=dict)


def level_eyes(matches: EyeMatches, rectifier: StereoRectifier) -> LevelledEyes:
    """Corrects the right camera by what moves rows; the rig as it is where all agree, or nothing makes most agree.

    What is significant is corrected beyond four of the standard deviations that the calibration claims, and where it
    moves rows by what is warned of; a yaw from there on alone, as lenses bend rows so, too. Rows that are all lower are
    those of a pitch or of another principal point, whichever leaves less; another size is that of fy alone where this
    makes pixels as square as the left ones, which rows cannot tell.

    Args:
        matches: in the images of `rectifier`.
    """
    fit, focal, camera = fit_rows(matches, rectifier.rectified), rectifier.rectified.fx, rectifier.camera
    claimed = {"shift": camera.sigmas.rotation, "roll": camera.sigmas.rotation, "zoom": camera.sigmas.distortion}
    if camera.covariance is not None:
        measured = dict(zip(camera.covariance.names, np.sqrt(np.diag(camera.covariance.matrix)).tolist(), strict=True))
        names = (("shift", "pitch"), ("roll", "roll"), ("zoom", "zoom"))
        claimed = {name: max(claimed[name], measured.get(error, 0.0)) for name, error in names}
    claimed["yaw"] = np.inf
    credible = {name: _CREDIBLE * focal * sigma for name, sigma in claimed.items()}
    given, first = LevelledEyes(rectifier, matches, fit), _wrong(fit, credible)
    stored, found, least = stored_places(matches, rectifier), [given], np.median(np.abs(matches.row_difference))
    for is_turned in (True, False) if "shift" in first else (True,) if first else ():
        eyes = given
        try:
            for _ in range(_ROUNDS):
                # What is large may hide others.
                wrong = {*eyes.causes, *_wrong(eyes.fit, credible)}
                more = {name: getattr(eyes.fit, name) for name in credible if name in wrong}
                causes = {name: eyes.causes.get(name, 0.0) + size for name, size in more.items()}
                other = StereoRectifier(_corrected(eyes, more, is_turned))
                moved = rectified_places(matches, stored, other)
                if len(moved) < MIN_MATCHES:
                    raise CalibrationError("the corrected eyes see nothing together")
                eyes = LevelledEyes(other, moved, fit_rows(moved, other.rectified), causes)
        except CalibrationError:  # no rig that could be
            continue
        rows = np.abs(moved.row_difference)
        if float((rows <= WARN_ROWS).mean()) > _LEVEL and np.median(rows) < least:
            found.append(eyes)
    best = min(found[1:] or found, key=lambda eyes: misfit(eyes.matches, eyes.rectifier.rectified))
    right, before = best.rectifier.camera.right, camera.right
    # If the left eye is the wrong one, the scale is: as likely as not.
    share = (right.fx / before.fx - 1.0) / np.sqrt(2.0)
    sigmas = replace(camera.sigmas, focal=float(np.hypot(camera.sigmas.focal, share)))
    return replace(best, rectifier=StereoRectifier(replace(best.rectifier.camera, sigmas=sigmas))) if share else best


def _wrong(fit: RowFit, credible: dict[str, float]) -> tuple[str, ...]:
    """Causes that are significant, and beyond what is credible of them, or of what is warned of."""
    sizes = {name: abs(getattr(fit, name)) for name in credible}
    return tuple(
        name
        for (name, size), sigma in zip(sizes.items(), fit.sigmas[:4].tolist(), strict=True)
        if size > SIGNIFICANT * sigma and (size > credible[name] or fit.most(name) > WARN_ROWS)
    )


def _corrected(eyes: LevelledEyes, causes: dict[str, float], is_turned: bool) -> StereoCamera:
    """The camera without causes of so many pixels; a shift is that of a turn, or of the principal point."""
    camera, focal = eyes.rectifier.camera, eyes.rectifier.rectified.fx
    shift, roll, zoom, yaw = (causes.get(name, 0.0) / focal for name in ("shift", "roll", "zoom", "yaw"))
    right, to_right = camera.right, eyes.rectifier.R_rectified_right
    aspect = right.fy / right.fx * camera.left.fx / camera.left.fy - 1.0
    wider = zoom * (abs(aspect) < 0.5 * abs(zoom))
    right = replace(right, fx=(1.0 + wider) * right.fx, fy=(1.0 + zoom) * right.fy)
    right = right if is_turned else replace(right, cy=right.cy + shift * right.fy)
    turn, _ = cv2.Rodrigues(np.array([shift * is_turned, -yaw, -roll]))
    R = camera.T_left_right[:3, :3] @ to_right.T @ turn @ to_right
    return replace(camera, right=right, T_left_right=rigid_motion(R, camera.T_left_right[:3, 3]))
