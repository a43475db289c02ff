"""Points of the scene followed through a whole sequence: what certifies a tracker where its own features may err."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from sigmaslam_synthetic.rendering.visibility import Sight
from sigmaslam_synthetic.simulation import Studio
from sigmaslam_synthetic.truth import arrive

_MAX_VIEWS = 200
_FRAMES_A_VIEW = 5  # new landmarks are taken in every so many frames ...
_CELLS = (10, 14)  # ... one in each cell of this raster of the left image
_STREAM = 101


@dataclass(frozen=True, slots=True)
class Landmarks:
    """L points on the surfaces of a scene.

    Attributes:
        points: (L, 3) metres, in the world, or in the frame of their body where that moves.
        facet: (L,) int64 facet of the renderer.
        body: (L,) int64 index into `Scene.bodies`.
    """

    points: np.ndarray
    facet: np.ndarray
    body: np.ndarray


def choose_landmarks(studio: Studio) -> Landmarks:
    """Points seen from along the path, spread over the image; the same for every process."""
    simulation = studio.simulation
    count = int(np.clip(simulation.frames // _FRAMES_A_VIEW, 1, _MAX_VIEWS))
    frames = np.unique(np.linspace(0, simulation.frames - 1, count).round().astype(int))
    rng = np.random.default_rng((simulation.seed, _STREAM))
    eye = studio.left
    cell = np.array([eye.camera.width / _CELLS[1], eye.camera.height / _CELLS[0]])
    corner = np.stack(np.meshgrid(np.arange(_CELLS[1]), np.arange(_CELLS[0])), axis=-1).reshape(-1, 2)
    points, facets = [], []
    for frame in frames:
        time = np.array([frame / simulation.fps])
        sight = studio.renderer.look(eye, simulation.path.poses(time), time)
        pixels = (corner + rng.random(corner.shape)) * cell - 0.5
        last = np.array([eye.camera.width - 1, eye.camera.height - 1])
        places = eye.to_grid(torch.from_numpy(np.clip(pixels, 0, last).T.copy()).to(studio.renderer.device))
        places = places[:, places.isfinite().all(dim=0)]
        view = torch.zeros(places.shape[1], dtype=torch.int64, device=places.device)
        facet = sight.resolve(view, places)
        places, view, facet = places[:, facet >= 0], view[facet >= 0], facet[facet >= 0]
        points.append(sight.points(view, facet, places).T.cpu().numpy())
        facets.append(facet.cpu().numpy())
    seen = np.concatenate(facets)
    return Landmarks(np.concatenate(points), seen, studio.renderer.body.cpu().numpy()[seen])


def observe(landmarks: Landmarks, left_sight: Sight, right_sight: Sight, number: int) -> dict[str, Any]:
    """Where the landmarks are seen by view `number` of the left and of the right camera.

    Returns:
        landmark (n,) int64 indices of those that at least one eye sees; left, right (n, 2) float64 exact pixels;
        left_visible, right_visible (n,) bool; depth (n,) float64 z in the left camera, metres.
    """
    device = left_sight.T_view_mover.device
    facet = torch.from_numpy(landmarks.facet).to(device)
    points = torch.from_numpy(landmarks.points.T.copy()).to(device)
    view = torch.full_like(facet, number)
    left, right = (arrive(sight, view, points, facet) for sight in (left_sight, right_sight))
    index = (left.visible | right.visible).nonzero().squeeze(1)
    return {
        "landmark": index.cpu().numpy(),
        "left": left.pixels[:, index].T.cpu().numpy(),
        "right": right.pixels[:, index].T.cpu().numpy(),
        "left_visible": left.visible[index].cpu().numpy(),
        "right_visible": right.visible[index].cpu().numpy(),
        "depth": left.depth[index].cpu().numpy(),
    }
