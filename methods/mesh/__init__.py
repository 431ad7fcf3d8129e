"""Isosurfaces as triangle meshes: flying edges, decimation, Draco, drawn by VTK."""
