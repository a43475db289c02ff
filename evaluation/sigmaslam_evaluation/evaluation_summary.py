"""An evaluation as a table of text."""

from sigmaslam_evaluation.evaluation_result import Evaluation, FinalErrors
from sigmaslam_evaluation.metrics.trajectory_errors import PoseNees, coverage
from sigmaslam_evaluation.relative_summary import format_relative

# Paths of endoscopes and of cameras at rest are told in millimetres, as metres of four digits would hide their errors.
_SHORT = 0.1
_LENGTHS = ("rmse", "mean", "median", "max")


def format_evaluation(evaluation: Evaluation) -> str:
    """The evaluation as a text table."""
    e = evaluation
    unit, size = ("mm", 1e-3) if e.path_length < _SHORT else ("m", 1.0)
    lines = [
        f"estimate  {e.estimate_path}",
        f"truth     {e.truth_path} (paired by {e.association})",
        f"frames    {e.matched} of the {e.frames} with a truth have an estimate ({100 * e.coverage:.1f} %)"
        + (f", {e.predicted} of them while lost, from the motion alone" if e.predicted else ""),
        f"path      {e.path_length / size:.2f} {unit} true, {e.estimate_path_length / size:.2f} {unit} estimated",
        *([f"The truth looks like {e.truth_hint}"] if e.truth_hint else []),
        *(f"The truth {note}" for note in e.truth_notes),
        "",
        f"{'':<24}" + "".join(f"{f'{name} [{unit}]':>12}" for name in _LENGTHS) + f"{'rotation [deg]':>16}",
        *_error_rows(e, size),
        "",
    ]
    if len(e.kitti.lengths):
        lines.append(f"{'KITTI segments':<24}{'count':>11}{'t_rel [%]':>11}{'r_rel [deg/100 m]':>19}")
        k, names = e.kitti, [f"{length:g} m" for length in e.kitti.lengths]
        rows = list(zip(names, k.counts, k.translation_percent, k.rotation_deg_per_100m, strict=True))
        rows.append(("all", k.counts.sum(), k.mean_translation_percent, k.mean_rotation_deg_per_100m))
        lines += [f"  {name:<22}{count:>11}{shift:>11.3f}{turn:>19.3f}" for name, count, shift, turn in rows]
    else:
        lines.append("KITTI segments: none, the path is shorter than a segment")
    lines += ["", _nees_line(e.nees)]
    if e.final is not None:
        lines += ["", "After the fact, with loops and smoothing (trajectory_final.tum):", *_error_rows(e.final, size)]
        lines.append(_nees_line(e.final.nees))
    words = ["", e.nees_verdict["text"]] if e.nees_verdict else []
    return "\n".join([*lines, "", *format_relative(e.relative), *words]) + "\n"


def _error_rows(errors: Evaluation | FinalErrors, size: float) -> list[str]:
    """ATE and RPE, a line each, in a unit of `size` metres."""
    # On a straight path the best alignment may turn about the path, by much more than the rotations are wrong.
    rotation_error = errors.ate_origin.rotation_rmse_deg
    straight = errors.ate.turn_deg > rotation_error and errors.ate.rotation_rmse_deg > 2 * rotation_error
    turn = "not determined" if straight else f"{errors.ate.rotation_rmse_deg:.4f}"
    rpe = errors.rpe
    steps = rpe.translation_rmse, rpe.translations.mean(), rpe.translation_median, rpe.translations.max()
    aligned, first = ((ate.rmse, ate.mean, ate.median, ate.maximum) for ate in (errors.ate, errors.ate_origin))
    rows = [
        ("ATE, best alignment", aligned, turn),
        ("ATE, first pose", first, f"{rotation_error:.4f}"),
        ("RPE, 1 frame", steps, f"{rpe.rotation_rmse_deg:.4f}"),
    ]
    return [
        f"{name:<24}{''.join(f'{each / size:>12.4f}' for each in metres)}{rotation:>16}"
        for name, metres, rotation in rows
    ]


def _nees_line(nees: PoseNees | None) -> str:
    if nees is None:
        return "NEES: no covariance"
    if len(nees.per_frame) == 0:
        return "NEES: no frame has a regular covariance"
    truth = ", with the errors of the truth" if nees.with_truth else ""
    return (
        f"NEES per degree of freedom (1 is right, more is overconfident){truth}: {nees.mean:.2f}; translation "
        f"{nees.mean_translation:.2f}, rotation {nees.mean_rotation:.2f}, median {nees.median:.2f}; "
        f"inside 95 %: {100 * coverage(nees.per_frame, 6):.0f} %"
    )
