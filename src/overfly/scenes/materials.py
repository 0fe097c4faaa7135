"""Codes of surfaces, shared by the scene builders and the shading kernel.

``shape`` holds four numbers of each face's material:

- walls: the along-wall coordinate where the wall starts, its ground-floor height, storey height and bay width (metres);
- roofs with rows (tiles, seams, corrugation): direction (cos, sin) of the horizontal along the ridge, row spacing, 0;
- foliage: size of the leaf clumps, metres;
- all others: unused.
"""

from __future__ import annotations

# Surfaces of faces.
GROUND = 0
WALL_WINDOWS = 1  # punched windows
WALL_RIBBON = 2  # bands of glass
WALL_GLASS = 3  # curtain wall
WALL_PLAIN = 4  # plaster or concrete
WALL_METAL = 5  # corrugated sheets
WALL_BRICK = 6
ROOF_TILES = 7
ROOF_GRAVEL = 8
ROOF_PLAIN = 9  # bitumen or membrane: nearly textureless
ROOF_METAL = 10  # standing seams
ROOF_GREEN = 11
FOLIAGE = 12
BARK = 13
PAINT = 14  # cars, sheets: plain colour
SOLAR = 15
VERTEX = 16  # colours of the vertices
TEXTURE = 17  # image texture

# What covers the ground.
MEADOW = 0
LAWN = 1
ASPHALT = 2
PAVING = 3
GRAVEL = 4
CROP = 5  # rows
PLOUGHED = 6
FOREST_FLOOR = 7
WATER = 8
PARKING = 9
DIRT = 10
GARDEN = 11
TRACK = 12  # railway ballast
RIPE = 13  # ripe cereal
