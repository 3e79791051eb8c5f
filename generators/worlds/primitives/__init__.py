"""Building blocks of every world: meshes, materials, textures, rigid bodies, the lamp."""
