"""Motion by an inertial sensor: pose since the keyframe, velocity, gravity, biases; before that constant velocity."""

import logging

import numpy as np

from sigmaslam.estimation.chi_square import CHI_SQUARE_999, CHI_SQUARE_9999_OF_6
from sigmaslam.estimation.constant_velocity import MotionFilter, MotionState
from sigmaslam.estimation.estimator_graphs import open_step
from sigmaslam.estimation.gaussian import at_most, matrix_root, regression
from sigmaslam.estimation.inertial_alignment import GravitySearch
from sigmaslam.estimation.inertial_buffer import InertialBuffer, LearnedNoise
from sigmaslam.estimation.mahalanobis import squared_mahalanobis
from sigmaslam.estimation.preintegration import GYRO_BIAS, TURN, Preintegrated
from sigmaslam.estimation.standstill import WHILE, Standstill, find_blow
from sigmaslam.estimation.wheel_speed import WheelSpeed
from sigmaslam.geometry.inertial_sensor import InertialSensor
from sigmaslam.geometry.se3 import nearest_rigid, rotation_log, se3_body, se3_exp, se3_inverse, se3_log, skew

_LOGGER = logging.getLogger(__name__)

# Order of the graph's error state, see sigmaslam_models.estimator.inertial_prediction.
_POSE, _VELOCITY, _GRAVITY = slice(0, 6), slice(6, 9), slice(9, 12)
# Delay, factors and mounting of the sensor, and the size of all.
_SENSOR, _GYRO_BIAS, _SIZE = slice(18, 43), slice(12, 15), 43
SENSOR_SIGMA = np.array([2e-3, *[5e-3] * 18, *[5e-3] * 3, *[3.5e-3] * 3])
"""Prior standard deviations of delay (s), scale and misalignment (shares of rate and force), place (m) and rotation
(rad) of the sensor. Those of careful calibrations: 2 ms, 5 mm and 0.2 degrees; 0.5 %, as factories leave 0.2 % and data
sheets without that 1 % (InvenSense MPU-6050, revision 3.4: 3 % of scale, 2 % across the axes at most)."""
# Seconds in which clocks drift and mounts bend, as they warm up, by as much as they are off at first.
_WARM_UP = 600.0
# Seconds without samples after which the sensor is taken for dead, and images in a row, of that much time at least,
# that contradict it after which it is taken for wrong.
_DEAD, _CONTRADICTIONS = 1.0, 8


class InertialMotion(MotionFilter):
    """Predicts by an inertial sensor; by constant velocity until gravity is known.

    Everything is in the frame of the last keyframe, so that nothing is far from zero. Delay, scale,
    misalignment and mounting of the sensor are part of the state: one that is mounted as believed to 0.2 degrees would
    fall aside by 17 mm in a second, one that is 0.5 % wrong by 35 mm once it has turned round.

    Args:
        T_camera_imu: (4, 4) takes points of the sensor into the camera that is tracked.
        wheels: measure the velocity besides.
    """

    def __init__(
        self, backend: str, sensor: InertialSensor, T_camera_imu: np.ndarray, wheels: WheelSpeed | None = None
    ) -> None:
        super().__init__(backend)
        self._predict_inertial = open_step("inertial_predict", backend)
        self.samples, self.noise, self._T_camera_imu = InertialBuffer(sensor), LearnedNoise(), T_camera_imu
        self._wheels, self._contradictions, self._mounting = wheels, 0, T_camera_imu
        self.sensors = {"imu": self.samples} | ({} if wheels is None else {"odometry": wheels.samples})
        self._velocity, self._gravity, self._biases = np.zeros(3), np.zeros(3), np.zeros(6)
        self._carried: np.ndarray | None = None
        self._search, self._T_first_key = GravitySearch(SENSOR_SIGMA), np.eye(4)
        self._time: float | None = None
        self._densities = np.zeros(2)
        self._standstill, self._is_dark = Standstill(sensor), False
        self.is_resting = False
        """The last prediction was one of a body at rest."""

    @property
    def state(self) -> MotionState:
        """What is known now."""
        if not self.is_inertial:
            return super().state
        others = np.concatenate([self._velocity, self._gravity, self._biases, np.zeros(25)])
        return MotionState(self.step.copy(), others, self._covariance.copy(), self._carried)

    def set_twist(self, twist: np.ndarray, sigma: np.ndarray) -> None:
        """Of constant velocity alone: the sensor measures on where images are lost."""
        if not self.is_inertial:
            super().set_twist(twist, sigma)
            self._search.poses.clear()

    def predict(
        self, seconds: float, densities: np.ndarray, sigma: float = 0.0, timestamp: float | None = None
    ) -> None:
        """Moves on to the frame of that time stamp, by the samples since the last one."""
        start, self._time, self._densities, self.turn = self._time, timestamp, densities, None
        if not self.is_inertial or start is None or timestamp is None:
            super().predict(seconds, densities, sigma)
            return
        sensor = self.samples.sensor
        self.samples.forget(start + self.samples.time_shift - WHILE)
        motion = self.samples.preintegrate(start, timestamp, self._biases, densities)
        if motion is None or motion.missing > _DEAD:
            _LOGGER.warning("the inertial sensor gives no samples: constant velocity goes on")
            self._leave(np.sqrt(np.diag(self._covariance)[_VELOCITY]))
            super().predict(seconds, densities)
            return
        walk = np.array([sensor.gyro_walk, sensor.accel_walk]) ** 2
        feed = {"pose": self.step, "velocity": self._velocity, "gravity": self._gravity, "walk": walk}
        feed |= {"mounting": self._T_camera_imu, "root": matrix_root(self._covariance), "slope": motion.slope}
        feed |= {"turn": motion.turn, "velocity_change": motion.velocity, "position_change": motion.position}
        feed |= {"seconds": np.array(motion.seconds), "noise": self.noise.of(motion)}
        step, velocity, covariance, carried = self._predict_inertial(feed)
        self.turn = self.step[:3, :3].T @ step[:3, :3]
        self.step, self._velocity = nearest_rigid(step), velocity
        self._covariance, self._carried, self.widened = 0.5 * (covariance + covariance.T), carried, 1.0
        self._covariance[_SENSOR, _SENSOR] += np.diag(SENSOR_SIGMA**2 * motion.seconds / _WARM_UP)
        self._note_twist(rotation_log(self.turn) / motion.seconds)
        self._measure_speed(motion, timestamp)
        if sigma > 0.0:
            self.doubt_time(sigma)

    def widen(self, factor: float) -> None:
        """Pose and velocity are off by more than the prediction claims; gravity and biases are not to blame."""
        if not self.is_inertial:
            super().widen(factor)
            return
        scale = np.ones(_SIZE)
        scale[: _VELOCITY.stop] = np.sqrt(factor)
        self._covariance, self.widened = scale[:, None] * self._covariance * scale, factor * self.widened

    def correct(self, step: np.ndarray, covariance: np.ndarray) -> None:
        """Takes over the posterior of the pose, which knew the prediction; looks for gravity while it is unknown."""
        if not self.is_inertial:
            super().correct(step, covariance)
            found = None
            if self._time is not None:
                pose = self._T_first_key @ self.step
                found = self._search.find(self._time, pose, self.samples, self._T_camera_imu, self._densities)
            if found is not None:
                R = self._T_first_key[:3, :3].T
                self._velocity, self._gravity, self._biases = R @ found.velocity, R @ found.gravity, found.biases
                turn, zero = np.eye(12), np.zeros((6, 37))
                turn[:3, :3] = turn[3:6, 3:6] = R
                shared = turn @ found.shared
                others = [[turn @ found.covariance @ turn.T, shared], [shared.T, np.diag(SENSOR_SIGMA**2)]]
                self._covariance = np.block([[self.step_covariance, zero], [zero.T, np.block(others)]])
                self.is_inertial, self._carried, self.widened = True, None, 1.0
                self._note_twist(self.twist[3:])
            return
        P = self._covariance
        departure = se3_log(step @ se3_inverse(self.step))
        is_excluded = squared_mahalanobis(departure, self.predicted_covariance) > CHI_SQUARE_9999_OF_6
        self._contradictions = self._contradictions + 1 if is_excluded else 0
        # What images leave of the prediction; where they know less of the pose than it, they teach nothing.
        kept = at_most(covariance, P[_POSE, _POSE])
        removed = P[_POSE, _POSE] - kept
        if not self.is_resting:  # vibrations come with motion
            self.noise.learn(departure, removed)
        gain = regression(P[6:, _POSE], P[_POSE, _POSE])
        change, others = gain @ departure, P[6:, 6:] - gain @ removed @ gain.T
        if self._contradictions > _CONTRADICTIONS // 2:  # by no such error as a sensor has, as it is described
            sensor = slice(_SENSOR.start - 6, None)
            change[sensor], others[sensor, sensor] = 0.0, P[_SENSOR, _SENSOR]
        self._move(change)
        self.step = nearest_rigid(step)
        self._covariance = np.block([[covariance, kept @ gain.T], [gain @ kept, 0.5 * (others + others.T)]])
        self._note_twist(self.twist[3:])
        if self._time is not None:
            recent = self.samples.around(self._time - WHILE, self._time)
            pose, spread = self._T_first_key @ self.step, se3_body(self.step, covariance)
            self._standstill.see(self._time, pose, spread, recent, self.noise.scale * self.samples.spectra)
            if self._wheels is not None:
                self._wheels.compare(self._time, self.twist, float(self._densities[0]))
        self._is_dark = False
        if self._contradictions == _CONTRADICTIONS:
            _LOGGER.warning("images contradict the inertial sensor: constant velocity until gravity is found anew")
            self._leave(np.full(3, np.sqrt(self._densities[0])))

    def start_keyframe(self) -> None:
        """The current pose is the keyframe's from now on: velocity and gravity turn into its frame."""
        self._T_first_key = self._T_first_key @ self.step
        if not self.is_inertial:
            super().start_keyframe()
            return
        turn = np.eye(_SIZE)
        R = self.step[:3, :3].T
        for part, vector in ((_VELOCITY, self._velocity), (_GRAVITY, self._gravity)):
            turn[part, part], turn[part, 3:6] = R, R @ skew(vector)
        self._velocity, self._gravity = R @ self._velocity, R @ self._gravity
        self._covariance = turn @ self._covariance @ turn.T
        super().start_keyframe()

    # ---- parts

    def _move(self, change: np.ndarray) -> None:
        """Adds (37,) to all but the pose."""
        self._velocity = self._velocity + change[:3]
        self._gravity = self._gravity + change[3:6]
        self._biases = self._biases + change[6:12]
        self.samples.time_shift += float(change[12])
        self.samples.factors = self.samples.factors + change[13:31].reshape(2, 3, 3)
        self._T_camera_imu = nearest_rigid(se3_exp(change[31:]) @ self._T_camera_imu)

    def _measure(self, residual: np.ndarray, slope: np.ndarray, noise: np.ndarray) -> None:
        """Kalman update without images: measured less predicted (m,), its slope (m, 43) and its covariance (m, m)."""
        P = self._covariance
        gain = regression(P @ slope.T, slope @ P @ slope.T + noise)
        change, kept = gain @ residual, np.eye(_SIZE) - gain @ slope
        self._covariance = kept @ P @ kept.T + gain @ noise @ gain.T
        if self._carried is not None:
            self._carried = self._carried @ kept.T
        self.step = nearest_rigid(se3_exp(change[_POSE]) @ self.step)
        self._move(change[6:])
        self._note_twist(self.twist[3:])

    def _measure_speed(self, motion: Preintegrated, timestamp: float) -> None:
        """A body at rest measures velocity zero and the gyro's bias, wheels the velocity; blows may turn the sensor."""
        was_dark, self._is_dark = self._is_dark, True
        recent, P = self.samples.around(timestamp - WHILE, timestamp), self._covariance[_VELOCITY, _VELOCITY]
        blow = find_blow(recent, timestamp + self.samples.time_shift - motion.seconds)
        if blow is not None:
            _LOGGER.warning("the inertial sensor felt a blow at %.3f s, %.0f m/s^2: do the cameras still fit?", *blow)
            self._covariance[_SENSOR, _SENSOR] += np.diag(SENSOR_SIGMA**2)  # as after a warm-up
            variance = (blow[1] * np.diff(recent[:, 0]).max()) ** 2 * np.eye(3)  # or a sample went wrong
            self._covariance[:3, :3] += motion.seconds**2 * variance
            P += variance
        self.is_resting = motion.missing == 0.0 and self._standstill.holds(recent, self._velocity, P, was_dark)
        if self.is_resting:
            slope, noise = np.zeros((6, _SIZE)), np.zeros((6, 6))
            slope[:3, _VELOCITY], slope[3:, _GYRO_BIAS] = np.eye(3), motion.slope[TURN, GYRO_BIAS]
            # Successive frames share the images, or the lack of them, of that while.
            noise[:3, :3] = self._standstill.speed_variance * max(WHILE / motion.seconds, 1.0)
            noise[3:, 3:] = motion.seconds * np.diag(self._standstill.spectra[:3])
            self._measure(np.r_[-self._velocity, -rotation_log(motion.turn)], slope, noise)
        found = None if self._wheels is None else self._wheels.measure(timestamp, motion.seconds, self.twist)
        if found is not None:
            residual, R, noise = found
            R, slope = R @ self.step[:3, :3].T, np.zeros((3, _SIZE))
            slope[:, _VELOCITY], slope[:, 3:6] = R, R @ skew(self._velocity)
            if squared_mahalanobis(residual, slope @ self._covariance @ slope.T + noise) < CHI_SQUARE_999[3]:
                self._measure(residual, slope, noise)

    def _leave(self, sigma: np.ndarray) -> None:
        """Constant velocity again, known to (3,) m/s, until gravity is found anew.

        A sensor that images contradict counts as it was described.
        """
        pose, is_wrong = self.step_covariance.copy(), self._contradictions > 0
        self.is_inertial, self._covariance, self._contradictions = False, np.zeros((12, 12)), 0
        self._covariance[_POSE, _POSE] = pose
        self.set_twist(self.twist, np.r_[sigma, np.full(3, self._densities[1])])
        if is_wrong:
            self.noise, self.samples.time_shift = LearnedNoise(), self.samples.sensor.time_shift
            self._T_camera_imu, self.samples.factors = self._mounting, np.zeros((2, 3, 3))

    def _note_twist(self, rate: np.ndarray) -> None:
        """The camera's twist in its own frame, at that angular rate (3,)."""
        T_kc = self.step
        self.twist = np.r_[T_kc[:3, :3].T @ self._velocity - np.cross(rate, self._T_camera_imu[:3, 3]), rate]
