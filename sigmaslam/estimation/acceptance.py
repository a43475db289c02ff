"""The rules of acceptance: what lets a pose be said. `docs/acceptance.csv` says where each acts and who measured it."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Acceptance:
    """Bounds by which poses, and what they are made from, are believed. Least inliers are of `TrackerConfig`.

    Attributes:
        stereo_fall: share of the usual share of followed landmarks that have a disparity; with less the eyes may be
            swapped, which following cannot tell.
        stereo_usual_gain: per frame, by which the usual share follows; after a fall, too, so that what stays becomes
            usual.
        guided_share: of the matches near a prediction, lest it be a mover's; for `left_over` after an odd interval.
        unguided_share: of the matches near a pose without a prediction; fewer suffice, it was told from movers before.
        doubtful_nis: NIS per degree of freedom; a fit above it may sit in a wrong place.
        noise_nis: likewise where half of the matches agree: half of what chance agreement in pure noise has.
        doubtful_inliers: times the least inliers above these; so large a noise excuses chance agreement of a few.
        left_over: share of the landmarks of the last frame; what covers the view leaves more from frame to frame.
        last_keyframes: number compared without a prediction; one of them may be blurred or covered.
        unguided_margin: share of the scene's depth, and radians, that an unguided pose is off by beyond its covariance.
        probable_share: of the matches that should be right by their probabilities; symmetric texture gives less.
        improbable_inliers: times the least inliers below that share, and where the motion excludes the pose.
        confirmed_share: of a keyframe's landmarks that look alike from a pose; from a wrong one hardly any is there.
        clear_share: of all landmarks that a pose foresees, however they look; more is believed against the motion.
        rival_area: share of the image that the greater motion explains; a lesser one is a wrong lens or chance.
        scene_farther: ratio of median disparities; of two rivals the scene lies behind what moves.
        same_motion: pixels between what two poses see, in the median; nearer ones say the same.
        scaled_agreement: share of the views that agree at the frame's own noise scale; with fewer they are outliers.
        max_noise_scale: of variances; right matches err by no more than three times what they claim, all together.
        second_motion: share of the image that another motion explains, of what both do; from there on nobody knows.
        mover: share of the image that what moves before the scene explains, of what both do; below it is chance.
        mover_points: times the least that make a pose; fewer are chance.
        time_error: frames by which an image is another moment's; drives that brake stay below a tenth.
        time_share: of a pose's departure that goes as the velocity does, where the stamp is wrong and not the pose.
        bump: pixels; by more the right eye sees all landmarks elsewhere than before, and by less each for itself.
        jump: sigmas of the prediction by which a pose that was found without it departs.
        jump_support: share of the landmarks of earlier keyframes in view that must confirm such a pose.
        sharpness: share of what keyframes saw of the same landmarks; drives give 0.86 to 1.2, motion blur over 11 px
            0.6 to 0.78.
        equal_blur: what gradients change by between two images, least over most along any direction; below it motion
            has blurred only one of them, if it has.
        even_sharpness: of the least sharp direction of an image, over the sharpest; below it motion has blurred it.
        streak_sharpness: of the least sharp direction, per squared pixel of half the image; stripes have more.
        noise_contrast: variance between blocks of an image by that of white noise of its pixels; scenes have more.
        stands: pixels; landmarks of a camera that stands depart by less from where they were, others by thrice that.
        other_moment: ratio of scatters; rows fit the other eye's a frame before by so much better where an eye is late.
        changed_image: share of the variance of most of the image that has changed; from there on the scene has moved.
        least_sharpness: share of what keyframes saw; bounds by how much a blurred frame is less certain.
        usual_clustering: factor on variances; nine of ten quiet frames stay below, above it one frame is believed.
        scattered_nis: NIS per degree of freedom; a blurred view above it would spoil what comes after, as a keyframe.
        bad_keyframe_landmarks: share of the last keyframe's; below it a blurred view is better than none.
        keyframe_points: times the least inliers, of stereo points; most of them are lost until the next keyframe.
        start_stereo_share: of the keypoints seen by both eyes; with less a first keyframe may be of one eye alone.
        swapped_share: of the disparities behind infinity; no offset puts more there, swapped eyes do.
        exchanged_share: of the last keyframe's disparities; with less the eyes are tried the other way round.
        swapped_disparity: pixels; a lesser disparity is behind infinity whatever the offset.
    """

    stereo_fall: float = 0.6
    stereo_usual_gain: float = 0.2
    guided_share: float = 0.5
    unguided_share: float = 0.3
    doubtful_nis: float = 2.0
    noise_nis: float = 4.0
    doubtful_inliers: int = 3
    left_over: float = 0.25
    last_keyframes: int = 3
    unguided_margin: float = 0.01
    probable_share: float = 0.5
    improbable_inliers: int = 3
    confirmed_share: float = 0.3
    clear_share: float = 0.25
    rival_area: float = 1 / 3
    scene_farther: float = 1.25
    same_motion: float = 2.0
    scaled_agreement: float = 0.95
    max_noise_scale: float = 9.0
    second_motion: float = 0.2
    mover: float = 0.05
    mover_points: int = 3
    time_error: float = 0.5
    time_share: float = 0.8
    bump: float = 1.0
    jump: float = 10.0
    jump_support: float = 0.5
    sharpness: float = 0.8
    equal_blur: float = 0.65
    even_sharpness: float = 0.38
    streak_sharpness: float = 0.09
    noise_contrast: float = 2.0
    stands: float = 0.5
    other_moment: float = 2.0
    changed_image: float = 0.1
    least_sharpness: float = 0.1
    usual_clustering: float = 2.0
    scattered_nis: float = 1.6
    bad_keyframe_landmarks: float = 0.5
    keyframe_points: int = 2
    start_stereo_share: float = 0.25
    swapped_share: float = 0.1
    swapped_disparity: float = -1.0
    exchanged_share: float = 0.25


ACCEPTANCE = Acceptance()
"""The one of the tracker."""
