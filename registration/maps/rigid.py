"""Rigid transforms of space."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from registration.volume import Array


@dataclass(frozen=True)
class RigidTransform:
    """Map x -> R x + t of points in RAS mm. matrix: (4, 4), R a proper rotation."""

    matrix: Array

    def __post_init__(self) -> None:
        if np.shape(self.matrix) != (4, 4):
            raise ValueError(f"matrix must be (4, 4), got {np.shape(self.matrix)}")
        r = self.matrix[:3, :3]
        if np.abs(r @ r.T - np.eye(3)).max() > 1e-6 or np.linalg.det(r) < 0:
            raise ValueError("matrix must hold a proper rotation; its rows are not orthonormal and right-handed")

    @classmethod
    def identity(cls) -> RigidTransform:
        """The map that leaves every point where it is."""
        return cls(np.eye(4))

    @classmethod
    def about(cls, centre: Array, rotation_vector: Array, translation: Array) -> RigidTransform:
        """Rotation by a vector (3,) in radians about `centre` (3,), then a shift (3,) in mm."""
        m = np.eye(4)
        m[:3, :3] = Rotation.from_rotvec(np.asarray(rotation_vector, dtype=float)).as_matrix()
        m[:3, 3] = np.asarray(centre) + translation - m[:3, :3] @ np.asarray(centre)
        return cls(m)

    def __call__(self, points_ras: Array) -> Array:
        """R x + t of points (n, 3) in RAS mm."""
        return np.asarray(points_ras, dtype=float) @ self.matrix[:3, :3].T + self.matrix[:3, 3]

    def __matmul__(self, inner: RigidTransform) -> RigidTransform:
        """x -> self(inner(x))."""
        return RigidTransform(self.matrix @ inner.matrix)

    def inverse(self) -> RigidTransform:
        """The map back."""
        m = np.eye(4)
        m[:3, :3] = self.matrix[:3, :3].T
        m[:3, 3] = -m[:3, :3] @ self.matrix[:3, 3]
        return RigidTransform(m)

    @property
    def angle_degrees(self) -> float:
        """Rotation angle in degrees."""
        return float(np.degrees(Rotation.from_matrix(self.matrix[:3, :3]).magnitude()))
