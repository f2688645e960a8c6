"""What the lung is made of. Ref: Alvarez 2021, table 1."""

from __future__ import annotations

from dataclasses import dataclass

GRAVITY_KPA_PER_MM = 9.81e-6  # weight of 1 kg/m3: 9.81 Pa/m


@dataclass(frozen=True)
class Tissue:
    """Poroelastic tissue: moduli in kPa, densities in kg/m3, permeability in m2, viscosity in Pa s, pressures in
    kPa.
    """

    young_kpa: float = 0.55
    poisson: float = 0.35
    biot: float = 1.0
    density_solid: float = 700.0
    density_fluid: float = 1.205
    permeability_m2: float = 2.75e-17
    viscosity_pa_s: float = 1.83e-5
    bronchial_kpa: float = 0.0
    pleural_kpa: float = 0.49

    def __post_init__(self) -> None:
        if not (self.young_kpa > 0 and -1 < self.poisson < 0.5):
            raise ValueError(f"need E > 0 and -1 < nu < 0.5, got E {self.young_kpa} kPa, nu {self.poisson}")

    @property
    def lame_kpa(self) -> float:
        """First Lame constant. Ref: Alvarez 2021, eq. 3."""
        return self.young_kpa * self.poisson / ((1 + self.poisson) * (1 - 2 * self.poisson))

    @property
    def shear_kpa(self) -> float:
        """Shear modulus. Ref: Alvarez 2021, eq. 3."""
        return self.young_kpa / (2 * (1 + self.poisson))

    @property
    def mobility(self) -> float:
        """kappa / mu_f in mm2/(Pa s), so that mobility / kappa_b is the layer thickness squared."""
        return self.permeability_m2 / self.viscosity_pa_s * 1e6

    def density(self, porosity: float) -> float:
        """kg/m3. Ref: Alvarez 2021, eq. 6."""
        return self.density_solid * (1 - porosity) + self.density_fluid * porosity

    def layer_mm(self, kappa_b: float) -> float:
        """Thickness of the pressure layer under the pleura, sqrt(kappa / (mu_f kappa_b))."""
        return float((self.mobility / kappa_b) ** 0.5) if kappa_b > 0 else float("inf")
