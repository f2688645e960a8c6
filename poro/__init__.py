"""Lung mechanics: tetrahedra, steady poroelasticity with air evacuation, contact and fit."""
