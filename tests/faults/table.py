"""All faults."""

from tests.faults.calibration_cases import CALIBRATION_CASES
from tests.faults.file_cases import FILE_CASES
from tests.faults.image_cases import IMAGE_CASES
from tests.faults.process_cases import PROCESS_CASES

CASES = [*IMAGE_CASES, *CALIBRATION_CASES, *FILE_CASES, *PROCESS_CASES]
