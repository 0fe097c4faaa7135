"""How one picture may lie on another before they are compared: by priors over level ground, or by quarter turns.

Homographies [3, 3] map full pixels of the first picture to those of the second.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from overfly.geometry import Array, Camera, invert

FARTHEST = 0.35
"""How far from the edge of one picture, in its sizes, its priors may put the other one for both to be compared: GPS,
relief and gimbals move what they see."""


class Prior(NamedTuple):
    """Roughly where a frame was taken from.

    Attributes:
        camera: of the full image; its distortion is left out of account.
        world_from_camera: [4, 4], metres, with the ground at z = 0.
    """

    camera: Camera
    world_from_camera: Array


def by_priors(first: Prior | None, second: Prior | None) -> list[Array]:
    """How the second picture lies on the first by the ground plane between their priors, if both are known."""
    if first is None or second is None:
        return []
    return [_over_ground(second) @ np.linalg.inv(_over_ground(first))]


def apart(first: Prior | None, second: Prior | None) -> bool:
    """Whether priors put the second picture clearly beside the first on level ground; False where one is unknown."""
    if first is None or second is None:
        return False
    camera = second.camera
    outline = np.array([[0, 0], [camera.width, 0], [camera.width, camera.height], [0, camera.height]], float)
    seen = np.column_stack([outline, np.ones(4)]) @ (_over_ground(first) @ np.linalg.inv(_over_ground(second))).T
    if not (seen[:, 2] * np.sign(seen[:, 2].sum()) > 0).all():  # the horizon is in the picture
        return False
    at = seen[:, :2] / seen[:, 2:] / [first.camera.width, first.camera.height]
    return bool((at.min(0) > 1 + FARTHEST).any() or (at.max(0) < -FARTHEST).any())


def quarter_turns(first: tuple[int, int], second: tuple[int, int]) -> list[Array]:
    """How a second picture may lie on a first one, of which only the sizes (width, height) are known."""
    sizes = [np.array(size, float) for size in (first, second)]
    zoom = sizes[1].max() / sizes[0].max()
    guesses = []
    for cosine, sine in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        turn = np.eye(3)
        turn[:2, :2] = zoom * np.array([[cosine, -sine], [sine, cosine]])
        turn[:2, 2] = sizes[1] / 2 - turn[:2, :2] @ sizes[0] / 2
        guesses.append(turn)
    return guesses


def _over_ground(prior: Prior) -> Array:
    """The homography [3, 3] from the ground (x, y, 1) to pixels."""
    return np.asarray((prior.camera.matrix() @ invert(prior.world_from_camera)[:3])[:, [0, 1, 3]])
