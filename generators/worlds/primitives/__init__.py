"""What every world is made of: meshes, materials, textures, rigid bodies, the lamp."""
