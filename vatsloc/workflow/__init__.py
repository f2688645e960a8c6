"""The two-phase localization: change of pose, then pneumothorax."""
