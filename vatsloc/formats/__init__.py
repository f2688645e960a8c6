"""Files to arrays in RAS mm and back: images, masks, markups, transforms, displacement fields and meshes."""
