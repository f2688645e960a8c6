"""Image registration for chest images: rigid spine, free-form deformation, sliding and inversion."""
