"""An evaluation as a table of text."""

from sigmaslam_evaluation.evaluation_result import Evaluation, FinalErrors
from sigmaslam_evaluation.metrics.trajectory_errors import PoseNees, coverage
from sigmaslam_evaluation.nees_verdict import judge_nees
from sigmaslam_evaluation.relative_summary import format_relative


def format_evaluation(evaluation: Evaluation) -> str:
    """The evaluation as a text table."""
    e = evaluation
    lines = [
        f"estimate  {e.estimate_path}",
        f"truth     {e.truth_path} (paired by {e.association})",
        f"frames    {e.matched} of the {e.frames} with a truth have an estimate ({100 * e.coverage:.1f} %)"
        + (f", {e.predicted} of them while lost, from the motion alone" if e.predicted else ""),
        f"path      {e.path_length:.2f} m true, {e.estimate_path_length:.2f} m estimated",
        *([f"The truth looks like {e.truth_hint}"] if e.truth_hint else []),
        *(f"The truth {note}" for note in e.truth_notes),
        "",
        f"{'':<24}{'rmse [m]':>11}{'mean [m]':>11}{'median [m]':>12}{'max [m]':>11}{'rotation [deg]':>16}",
        *_error_rows(e),
        "",
    ]
    if len(e.kitti.lengths):
        lines.append(f"{'KITTI segments':<24}{'count':>11}{'t_rel [%]':>11}{'r_rel [deg/100 m]':>19}")
        k = e.kitti
        columns = (k.lengths, k.counts, k.translation_percent, k.rotation_deg_per_100m)
        for length, count, translation, rotation in zip(*columns, strict=True):
            lines.append(f"{f'  {length:g} m':<24}{count:>11}{translation:>11.3f}{rotation:>19.3f}")
        lines.append(
            f"{'  all':<24}{e.kitti.counts.sum():>11}{e.kitti.mean_translation_percent:>11.3f}"
            f"{e.kitti.mean_rotation_deg_per_100m:>19.3f}"
        )
    else:
        lines.append("KITTI segments: none, the path is shorter than a segment")
    lines += ["", _nees_line(e.nees)]
    if e.final is not None:
        lines += ["", "After the fact, with loops and smoothing (trajectory_final.tum):", *_error_rows(e.final)]
        lines.append(_nees_line(e.final.nees))
    verdict = judge_nees(e.nees, e.relative)
    words = ["", verdict["text"]] if verdict else []
    return "\n".join([*lines, "", *format_relative(e.relative), *words]) + "\n"


def _error_rows(errors: Evaluation | FinalErrors) -> list[str]:
    """ATE and RPE, a line each."""
    # On a straight path the best alignment may turn about the path, by much more than the rotations are wrong.
    rotation_error = errors.ate_origin.rotation_rmse_deg
    straight = errors.ate.turn_deg > rotation_error and errors.ate.rotation_rmse_deg > 2 * rotation_error
    turn = "not determined" if straight else f"{errors.ate.rotation_rmse_deg:.4f}"
    rows = [
        f"{name:<24}{ate.rmse:>11.4f}{ate.mean:>11.4f}{ate.median:>12.4f}{ate.maximum:>11.4f}{rotation:>16}"
        for name, ate, rotation in (
            ("ATE, best alignment", errors.ate, turn),
            ("ATE, first pose", errors.ate_origin, f"{errors.ate_origin.rotation_rmse_deg:.4f}"),
        )
    ]
    rpe = errors.rpe
    name = f"RPE, {rpe.delta} frame" + ("s" if rpe.delta > 1 else "")
    return [
        *rows,
        f"{name:<24}{rpe.translation_rmse:>11.4f}{rpe.translations.mean():>11.4f}"
        f"{rpe.translation_median:>12.4f}{rpe.translations.max():>11.4f}{rpe.rotation_rmse_deg:>16.4f}",
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
