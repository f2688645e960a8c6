"""One person's thorax as tissue: organs, trees, nodule, and their densities, ready to be imaged in any state."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from phantoms.anatomy import Build, Shapes, draw_build, make_shapes, spine_y
from phantoms.fields import Lattice, coverage, smooth_noise
from phantoms.lobes import Fissures, Lobes, Sheet, cut, whole
from phantoms.nodule import Nodule
from phantoms.patient import Patient
from phantoms.skeleton import Vertebra, draw_bones, draw_spine
from phantoms.soft_tissue import image_soft_tissue
from phantoms.spec import Lesion
from phantoms.trees import LungTrees, Tree, draw_tubes, grow, tubes
from phantoms.voxels import Grid

Array = NDArray[Any]
BLOOD_HU, WALL_HU, AIR_HU = 42.0, 10.0, -990.0


@dataclass(frozen=True)
class Thorax:
    """A person. parenchyma: HU of the lung's tissue without its trees, in the CT; hila: (right, left) RAS mm; lobes:
    those of the operated lung."""

    shapes: Shapes
    spine: list[Vertebra]
    parenchyma: Lattice
    hila: tuple[Array, Array]
    trees: tuple[LungTrees, LungTrees]
    nodule: Nodule
    lobes: Lobes
    side: str
    seed: int

    @property
    def build(self) -> Build:
        """Measures of the person."""
        return self.shapes.build

    @property
    def patient(self) -> Patient:
        """What the collapse of the operated lung needs to know."""
        n = self.index(self.side)
        lung = operated_lung(self.shapes, self.side)
        return Patient(
            self.side,
            self.seed,
            self.build,
            lung,
            self.lobes,
            self.hila[n],
            self.nodule,
            self.parenchyma,
            self.trees[n],
        )

    def index(self, side: str) -> int:
        """Place of a side in the pairs of this class."""
        return 0 if side == "right" else 1


def draw_thorax(side: str, habitus: str, lesion: Lesion, seed: int, fused: float = 1.0) -> Thorax:
    """Person with a lesion in the lung on `side`, drawn from a seed. fused: share of the fissures' area over which the
    operated lung's lobes have grown together."""
    rng = np.random.default_rng([seed, 1])
    build = draw_build(rng, habitus)
    shapes = make_shapes(build)
    spine = draw_spine(build, float(shapes.body.origin[2]), build.apex + 16, rng)
    hila = (_hilum(shapes.right_lung, 1), _hilum(shapes.left_lung, -1))
    own = 0 if side == "right" else 1
    lung = operated_lung(shapes, side)
    parts = None if fused >= 1 else _cut(lung, hila[own], side, fused, seed)
    regions: list[tuple[Lattice, ...]] = [(shapes.right_lung,), (shapes.left_lung,)]
    regions[own] = regions[own] if parts is None else parts.regions
    trees = (lung_trees(regions[0], hila[0], 1, rng), lung_trees(regions[1], hila[1], -1, rng))
    centre = place_nodule(shapes.lung(side), build, lesion, 1 - 2 * own, parts, rng)
    nodule = Nodule(centre, lesion.radius, 0.12 * lesion.radius, lesion.kind, lesion.seen)
    line = Sheet(hila[own], 8.0, rng.uniform(0.7, 1.1), rng.uniform(-8, 8))
    lobes = parts or whole(lung, Fissures(line, None, np.inf))
    return Thorax(shapes, spine, _parenchyma(shapes, rng), hila, trees, nodule, lobes, side, seed)


def operated_lung(shapes: Shapes, side: str) -> Lattice:
    """Signed distance (mm) of the lung on `side`, on no more of the lattice than it needs."""
    lung = shapes.lung(side)
    return lung.crop(lung.values < 0, 24.0)


def _cut(lung: Lattice, hilum: Array, side: str, fused: float, seed: int) -> Lobes:
    rng = np.random.default_rng([seed, 3])
    oblique = Sheet(hilum, 8.0, rng.uniform(0.7, 1.1), rng.uniform(-8, 8))
    horizontal = Sheet(hilum, rng.uniform(-8, 0), rng.uniform(-0.1, 0.1), rng.uniform(-6, 6))
    return cut(lung, Fissures(oblique, horizontal if side == "right" else None), fused)


def ct_grid(thorax: Thorax, spacing: tuple[float, float, float]) -> Grid:
    """Image grid of the CT: axes to the left, back and top of the patient, the whole lattice of shapes inside."""
    body = thorax.shapes.body
    low = body.origin
    high = low + body.spacing * (np.array(body.values.shape) - 1)
    step = np.array([-spacing[0], -spacing[1], spacing[2]])
    n = np.floor((high - low) / np.abs(step)).astype(int)
    affine = np.diag([*step, 1.0])
    affine[:3, 3] = [high[0], high[1], low[2]]
    return Grid((int(n[0]), int(n[1]), int(n[2])), affine)


def image_body(thorax: Thorax, grid: Grid, open_lungs: tuple[str, ...]) -> Array:
    """Noise-free HU on `grid` of everything outside the lungs, and of the lungs named in `open_lungs`.

    Where a lung is left out, its place is filled with the tissue that would be there without it.
    """
    rng = np.random.default_rng([thorax.seed, 2])
    s = thorax.shapes
    width = float(grid.spacing.mean())
    hu = image_soft_tissue(s, grid, width, rng)
    draw_bones(hu, grid, s.build, thorax.spine, rng)
    for side in open_lungs:
        lung = s.lung(side).on(grid)
        hu += coverage(lung, width) * (thorax.parenchyma.on(grid) - hu)
    _draw_great_tubes(hu, thorax, grid, width)
    for side in open_lungs:
        draw_lung_trees(hu, thorax.trees[thorax.index(side)], grid, width)
    return hu


def draw_table(hu: Array, grid: Grid, body: Lattice) -> None:
    """Paint the scanner's table under the back into a CT (HU): a hollow shell, bent a little around the patient."""
    x, y, _ = body.axes
    under = float(np.broadcast_to(y, body.values.shape)[(body.values < 0) & (np.abs(x) < 60)].min()) - 3
    at = grid.points()
    top = under + at[..., 0] ** 2 / 1500 - at[..., 1]
    free = body.on(grid) > 1.5
    hu[free & (top > 1.0) & (top < 11.0)] = -930
    for depth, thick in ((0.0, 1.6), (12.0, 1.2)):
        share = coverage(np.abs(top - depth - thick) - thick, float(grid.spacing.mean())) * free
        hu += share * (60 - hu)


def draw_lung_trees(hu: Array, trees: LungTrees, grid: Grid, width: float) -> None:
    """Paint vessels and airways of one lung into an image (HU) whose axes are parallel to those of the trees' frame."""
    rng = np.random.default_rng(7)
    blood = np.zeros(grid.shape, dtype=np.float32)
    for tree in (trees.artery, trees.vein):
        draw_tubes(blood, grid, *tubes(tree, 0.05, rng), width)
    hu += blood * (BLOOD_HU - hu)
    draw_airways(hu, grid, *tubes(trees.airway, 0.03, rng), width)


def draw_airways(hu: Array, grid: Grid, ends: Array, radii: Array, width: float) -> None:
    """Paint tubes with a wall and air inside. radii: (n, 2) mm of the lumen."""
    wall, lumen = np.zeros(grid.shape, dtype=np.float32), np.zeros(grid.shape, dtype=np.float32)
    draw_tubes(wall, grid, ends, radii + 0.3 + 0.1 * radii, width)
    draw_tubes(lumen, grid, ends, radii, width)
    hu += wall * (WALL_HU - hu)
    hu += lumen * (AIR_HU - hu)


def _draw_great_tubes(hu: Array, thorax: Thorax, grid: Grid, width: float) -> None:
    b = thorax.build
    blood = np.zeros(grid.shape, dtype=np.float32)
    for path, radius in _great_vessels(b, thorax.hila):
        ends = np.stack([path[:-1], path[1:]], axis=1)
        draw_tubes(blood, grid, ends, np.full((len(ends), 2), radius), width)
    hu += blood * (BLOOD_HU - hu)
    zs = np.linspace(b.apex, -190, 20)
    gullet = np.stack([np.full(20, -4.0), np.minimum(spine_y(b, zs) + 22, -26), zs], axis=1)
    ends = np.stack([gullet[:-1], gullet[1:]], axis=1)
    wall = np.zeros(grid.shape, dtype=np.float32)
    draw_tubes(wall, grid, ends, np.full((19, 2), 6.5), width)
    hu += wall * (38 - hu)
    draw_airways(hu, grid, ends[6:9], np.full((3, 2), 1.6), width)
    carina = np.array([0.0, -20.0, 10.0])
    wind = np.array([[0.0, -14.0, b.apex + 40], [0.0, -16.0, 60.0], carina])
    air = [[wind[0], wind[1]], [wind[1], wind[2]]]
    radii = [[8.6, 8.6], [8.6, 8.4]]
    for n, hilum in enumerate(thorax.hila):
        middle = 0.5 * (carina + hilum) + [0, 0, 2]
        air += [[carina, middle], [middle, hilum]]
        radii += [[7.4 - n, 7.0 - n], [7.0 - n, 6.2 - n]]
    draw_airways(hu, grid, np.array(air), np.array(radii), width)


def _great_vessels(b: Build, hila: tuple[Array, Array]) -> list[tuple[Array, float]]:
    """Paths (n, 3) and radii, mm: aorta and its branches, great veins, pulmonary trunk, its arteries and veins."""
    zs = np.linspace(20, -190, 16)
    descending = np.stack([np.full(16, -21.0), spine_y(b, zs) + 17, zs], axis=1)
    arch = np.array([[4, 18, -30], [9, 20, 4], [4, 13, 26], [-8, -4, 34], [-19, -22, 32], descending[0]])
    cava = np.array([[19, 14, 62], [22, 8, 20], [23, 8, -40]])
    trunk = np.array([[-16, 36, -32], [-20, 26, -10], [-16, 8, 0]])
    azygos = np.stack([np.full(16, 8.0), spine_y(b, zs) + 18, zs], axis=1)
    top = b.apex - 10
    paths: list[tuple[Array, float]] = [
        (arch, 14.5),
        (descending, 11.5),
        (cava, 9.5),
        (trunk, 13.5),
        (azygos, 3.2),
        (np.array([arch[2], [12, 2, 60], [24, -4, top]]), 6.0),
        (np.array([arch[3], [-13, -6, 60], [-22, -8, top]]), 4.4),
        (np.array([arch[4], [-21, -20, 60], [-40, -14, top + 4]]), 5.2),
        (np.array([cava[0], [2, 22, 52], [-24, 16, 66], [-44, 6, top]]), 6.5),
        (np.array([cava[0], [30, 8, top]]), 7.0),
    ]
    for n, hilum in enumerate(hila):
        sign = 1 - 2 * n
        root = hilum + np.array([0, 5, 2])
        between = np.array([-2.0, -2.0, -8.0]) if n == 0 else np.array([-22.0, -4.0, 2.0])
        paths.append((np.array([trunk[-1], between, root, hilum + np.array([9.0 * sign, 1, -4])]), 8.6))
        left_atrium = b.heart[0] + np.array([12.0 + 16 * sign, -30, 20])
        paths += [
            (np.array([left_atrium, hilum + np.array([0, 11, -15])]), 7.0),
            (np.array([left_atrium - [0, 0, 8], hilum + np.array([3.0 * sign, -2, -30])]), 5.6),
        ]
    return paths


def _hilum(lung: Lattice, sign: int) -> Array:
    """Where the main bronchus enters the lung: the innermost point at its level."""
    x = np.arange(0, 90, 0.5)
    line = np.stack([sign * x, np.full_like(x, -20), np.full_like(x, -14.0 - 4 * (sign < 0))], axis=1)
    inside = np.flatnonzero(lung.at(line) < 0)
    return line[inside[0]] if len(inside) else line[60]


def lung_trees(regions: tuple[Lattice, ...], hilum: Array, sign: int, rng: np.random.Generator) -> LungTrees:
    """Trees of a lung that enter at `hilum` (3,) mm and fill its lobes (signed distances, mm) one by one; sign: 1
    right, -1 left."""
    clouds = []
    for region in regions:
        coarse = np.argwhere(region.values[::2, ::2, ::2] < -1.0) * 2.0 * region.spacing + region.origin
        clouds.append(coarse + rng.uniform(-3, 3, coarse.shape))
    inward = np.array([sign * 12.0, -2.0, -6.0])
    bundle = grow(clouds, hilum - 0.6 * inward, hilum + 0.8 * inward, 12, 0.52, 2.75)
    veins = grow(
        [cloud + rng.uniform(-5, 5, cloud.shape) for cloud in clouds],
        hilum + np.array([0, 12, -14]) - 0.6 * inward,
        hilum + np.array([0, 11, -16]) + 0.8 * inward,
        12,
        0.5,
        2.75,
    )
    bundle, veins = (t.moved(_keep_inside(t, regions, 4.0)) for t in (bundle, veins))
    across = rng.standard_normal(bundle.nodes.shape)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    across = 0.3 * across + 0.7 * np.array([0.3 * sign, 0.5, 0.8])
    artery = bundle.moved(bundle.nodes + across * (2.1 * bundle.radius[:, None] + 0.8))
    if len(regions) > 1:
        artery = artery.moved(_keep_inside(artery, regions, 2.0))
    bronchi = bundle.moved(bundle.nodes, 0.72).keep(bundle.generation <= 7)
    return LungTrees(bronchi, artery, veins)


def _keep_inside(tree: Tree, regions: tuple[Lattice, ...], depth_mm: float) -> Array:
    """Nodes (n, 3) of a tree, those that left the lobe they feed brought back `depth_mm` below its surface."""
    nodes = tree.nodes.copy()
    for n, region in enumerate(regions):
        beyond = (tree.generation > 1) & (tree.cloud == n)
        for _ in range(4):
            distance, slope = region.with_gradient(nodes[beyond])
            steep = np.maximum((slope**2).sum(axis=1, keepdims=True), 0.25)
            nodes[beyond] -= np.maximum(distance + depth_mm, 0)[:, None] * slope / steep
    return nodes


def place_nodule(
    lung: Lattice, build: Build, lesion: Lesion, sign: int, lobes: Lobes | None, rng: np.random.Generator
) -> Array:
    """A centre (3,) mm for a lesion in a lung (signed distance, mm), clear of fissures; sign: 1 right, -1 left.

    Raises ValueError where the lung has no such place.
    """
    points = lung.points()
    apt = np.abs(lung.values.ravel() + lesion.depth) < 1.5
    if lobes is not None:
        apt &= lobes.fissures.distance(points) > 1.2 * lesion.radius + 2
    z, dome = points[:, 2], build.dome[0 if sign == 1 else 1]
    level, inner = {
        "middle": (np.abs(z + 45) < 45, 55),
        "apex": (z > 0.52 * build.apex, 20),
        "base": (z < dome + 1.5 * lesion.depth, 45),
    }[lesion.place]
    apt &= level & (sign * points[:, 0] > inner)
    if not apt.any():
        raise ValueError(
            f"the lung has no place for a nodule {lesion.depth:g} mm below the pleura in its {lesion.place}, "
            f"its deepest tissue lies {-lung.values.min():.0f} mm below; take a lung that holds air"
        )
    return points[apt][rng.integers(int(apt.sum()))] + rng.uniform(-1, 1, 3)


def _parenchyma(shapes: Shapes, rng: np.random.Generator) -> Lattice:
    lattice = shapes.right_lung
    _, y, _ = lattice.axes
    coarse, fine = smooth_noise(lattice, 14.0, rng), smooth_noise(lattice, 3.5, rng)
    dependent = -0.35 * (y + 10)
    rind = np.minimum(np.abs(shapes.right_lung.values), np.abs(shapes.left_lung.values))
    hu = -882 + dependent + 9 * coarse + 15 * np.clip(fine, -1.5, 3) + 12 * np.exp(-rind / 4)
    return lattice.like(ndimage.gaussian_filter(np.clip(hu, -940, -600), 0.4))
