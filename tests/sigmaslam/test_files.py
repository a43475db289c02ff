"""Files that are written whole or not at all."""

from pathlib import Path

import numpy as np

from sigmaslam.files import save_arrays


def test_arrays_are_written_to_the_name_that_is_given(tmp_path: Path):
    """numpy would add .npz to a name without it."""
    save_arrays(tmp_path / "map", points=np.arange(3))
    assert [path.name for path in tmp_path.iterdir()] == ["map"]
    with np.load(tmp_path / "map") as content:
        np.testing.assert_array_equal(content["points"], np.arange(3))
