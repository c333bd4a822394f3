# SPDX-License-Identifier: Apache-2.0

"""Changes the model that is learned: constants beside the settings.

Vote weights and the rule of refusal were chosen on the four objects of `bayes3d evaluate learning`; what the others
were chosen on is not recorded.
"""

import numpy as np

# What stands on the table in a view (`segment.py`)
# Metres beyond the setting `max_shift` above and below the table that the pose promises, in which it is looked for; and
# the least side of the area in which it is. Within a smaller workspace an object's top may be the larger plane.
TABLE_BEYOND, TABLE_AREA = 0.02, 1.0
LOWEST = 0.003, 0.010  # metres: the least and the largest height from which a return belongs to a thing
EDGE_SHARE = 0.02  # share of the depth by which neighbours of a good pixel may differ
FEWEST_PIXELS = 60  # that make a thing
SWELL = 1.5  # times the least height of a thing's returns: what nowhere rises above it is a swell of the table
FIRM = 0.6  # share of the returns around a pixel that rise as well where it is more than a speck of noise
FOOT_WITHIN = 0.04  # metres: what is not seen to reach down so far does not stand on the table, but flies or is held
NORMAL_RADIUS = 0.004  # metres of surface that a normal is fitted to, both ways, where views are aligned
EDGE_RADIUS = 0.002  # the same where they are fused: of a wall's top, 3.5 mm wide, 4 mm leave no normal but its sides'
# Metres beyond the setting `max_shift`, by which a view's camera pose may be off, from the place that is asked for to
# the nearest return of the thing there, and from a thing in one view to the same thing in another.
PLACE_ERROR = 0.02
# Sides of voxels over distances of neighbouring pixels on the object, at least. Five views of a box see 42 to 49 % of
# its surface at 1.4, 58 to 66 % at 1.6, 81 to 89 % at 2 and 85 to 91 % at 2.6.
PIXELS_A_VOXEL = 1.5
CUT_WITHIN = 3  # pixels from a thing to a return above the table that the settings leave out, which cuts it off

# Camera poses (`align.py`)
POSE_PRIOR = 0.015, 0.015, np.deg2rad(0.8)  # standard deviations of a pose's error at the object: m, m, radians
POINT_NOISE = 0.002  # metres, of a point against a surface of another view
CORRELATED_POINTS = 5  # neighbouring points share their errors: so many count as one
SAME_SIDE = 0.6  # cosine between normals of partners: the two sides of a wall are none
RIM = 16, 0.4  # neighbours; share of their mean distance by which their middle is off at the rim of a surface

# Refusal of views (`learn.py`)
SEEN_THROUGH = 0.015  # metres: a view that sees something so far behind a point sees through it
CONTRADICTED = 0.25  # share of a view's points that others see through, on average, from which it must go

# Smoothing (`smooth.py`)
LEAST_CELL = 0.0015  # metres: points in cubes of half a voxel, at least this, are taken together
WIDTHS = 0.002, 0.003, 0.0045, 0.0065  # metres: standard deviations of the weights that a surface is fitted with
REACH = 2.0  # such widths: points farther off do not count
ALIKE = 0.7  # cosine between normals of one side; also of voxels of one wall (`unseen.py`)
# Likewise where points are smoothed again, with the normals of the first fits: beside an edge those are of one side.
SHARPER = 0.9
AGREE = 2.0  # standard errors: a wider fit is taken where intervals of so many about it and all narrower ones meet
FEWEST_CELLS = 12  # that a fit needs

# Bodies of revolution (`revolution.py`)
SECTORS, FACINGS = 36, 16  # of azimuth; of directions across the profile
PROFILE_CELL, PROFILE_WIDTH = 0.001, 0.003  # metres: cells of the profile; standard deviation of a fit's weights
ONE_CURVE = 0.9  # cosine between normals of one curve, at least
PAST_EDGE = 0.0002  # metres above another side of the body from which a side has passed the edge between them
UPRIGHT_TURN = 0.35  # sine of the angle by which a normal of the body misses the plane through its axis, at most
# Metres from the curve at which points agree with it: three standard deviations of what is seen all round, clipped to
# this range.
ROUND_WITHIN = 0.0003, 0.0008
AROUND, AGREEING = 1 / 3, 0.8  # shares that agree: of the circle, of what is seen of it
# If more than this share of the voxels on a ring is free, those that no view saw inside the body are free.
HOLLOW = 1 / 12
BESIDE_BODY = 0.012  # metres: samples so near to points that are not of the body need points of the body beside them
NEAR_BODY = 0.004  # metres: points within half of this of the body are moved onto it, bulges beside a handle too

# Votes on voxels (`fuse.py`)
# Nats a view: log p(points in it | surface) / p(.. | free), and the reverse for rays through all of it or its middle.
HIT, PASS, GLIMPSE = 2.5, 3.0, 1.0
BEHIND_VOXEL = 0.004  # metres, beside the voxel's own size, that a return lies behind a voxel that its ray passed
LOW = 0.012  # metres: voxels so near to the table are free where the table is seen under them
FEWEST_VOXELS = 4  # of a piece that is kept
BESIDE_CRUMBS = 6  # voxels of the solid about an unseen one, with itself, at most, where that is a crumb and free
FOOT = 0.015  # metres: what is so near the lowest return, and walls so near the table, reach down to the table
STEEP = 0.5  # cosine between a wall's normal and the vertical, at most: it goes on down to the table
BELOW, BESIDE = 2.5, 0.3  # voxels to the lower part of a wall, at most: across the table; along the wall
GAP = 0.02  # metres: what is not seen is free where it is at most so wide and views look into it from both sides
BEHIND_WALL = 0.003  # metres behind a wall, beyond which a view sees through it
FACING = 0.3  # cosine between a wall's normal and the way to a camera that sees through it, or past it, at least
CONTINUED = 0.5  # cosine between normals of an unseen voxel and of a seen one whose plane goes on through it, at least
THIN = 3.0, 0.35  # a voxel is a neighbour's noise if that holds so many times its points, on a plane so near (voxels)
