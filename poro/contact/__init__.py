"""Frictionless contact of the lung with the rigid chest wall and of its pieces with each other, on the compliance of
its surface.

`ChestWall` gives gaps from a smooth signed distance (`LevelSet`), `Facing` those between two deformable surfaces,
`Compliance` how contact nodes move under forces, and `solve_contact` the forces by a primal-dual active set;
`contact_sensitivity` is their derivative, for one piece.
"""

from poro.contact.active_set import ContactState, ContactStatus, solve_contact
from poro.contact.chest_wall import ChestWall
from poro.contact.compliance import Compliance
from poro.contact.facing import Facing, Gaps
from poro.contact.levelset import LevelSet, level_set
from poro.contact.sensitivity import contact_sensitivity

__all__ = [
    "ChestWall",
    "Compliance",
    "ContactState",
    "ContactStatus",
    "Facing",
    "Gaps",
    "LevelSet",
    "contact_sensitivity",
    "level_set",
    "solve_contact",
]
