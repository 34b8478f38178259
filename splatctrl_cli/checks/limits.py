"""Sample sizes and thresholds of `splatctrl check`.

A unit in brackets precedes the meaning. Other numbers are shares, factors or counts.
"""

# Cameras: lenses, poses and pairs of images
LENS_SAME_FACTOR = 0.1  # by which both factors of another size may differ
LENS_CENTRE = 0.15  # of the image's size that a principal point may be off its middle
LENS_RATIO = 0.05  # by which fx / fy may differ from 1
LENS_FIELD_OF_VIEW = (20.0, 140.0)  # [deg], horizontal
POSES_LOOKED_UP = 20_000  # of a camera
POSES_JUMP = 0.2  # [m] from one frame to the next
POSES_JUMP_RATIO = 10.0  # times the median step
PAIRED_SHARE = 0.95  # of the images of the rarer topic
PAIRED_LATE = 0.010  # [s] between colour and depth at which an arm at 1 m/s is 1 cm apart
PAIRED_STAMPS = 20_000  # stamps of a topic that are paired
RATE_FEWEST = 5  # images that a rate is judged by
RATE_SLOWER = 1.5  # of the images of one topic that the other has at least, for a note

# Images: depth, its units, and edges that colour and depth share
KEPT_ROWS = 240  # that a kept depth image has at most
KEPT_IMAGES = 12  # depth images of a camera
THUMBNAIL_COLUMNS = 64  # of a thumbnail, by which motion is judged (clock_offset)
THUMBNAILS = 300  # of a camera
DECODED_IMAGES = 300  # of a topic
LITTLE_DEPTH = 0.10  # of the pixels
SOME_DEPTH = 0.5  # of the pixels
CONSTANT_SHARE = 0.02  # of an image's depth that has one exact value, the largest
CONSTANT_AHEAD = 2.0  # times the next depth that it is; nearer, where there are so many others:
CONSTANT_VALUES = 50  # values, which no drawn scene has
CONSTANT_RATIO = 2.0  # times as many pixels as any of those has
CONSTANT_IMAGES = 0.5  # of the images that share it
TABLE_DEPTH = (0.15, 8.0)  # [m] within which a median is usual
EDGE_FRAMES = 4  # of a camera
EDGE_STEP = 0.05  # of the depth, across an edge
EDGE_BORDER = 3  # [px] that are left out
EDGE_CLEAR = 0.2  # correlation of a peak, for it to be believed
EDGE_AHEAD = 1.35  # and how far it is above the next one
EDGE_SHIFT = 0.015  # of the width
EDGE_AROUND = 3  # [px] of a peak, and around no shift
EDGE_SEARCHED = 8  # a shift of up to an eighth of the image

# Times: gaps, delays and clocks of topics
KEPT_INTERVALS = 4096  # intervals and delays of a topic, however long the log
KEPT_GAPS = 1000  # the longest intervals
GAP_RATIO = 3.0  # of the median interval
GAP_SECONDS = 0.1  # [s]; a shorter gap costs nothing
REGULAR = 2.0  # times the median that nine of ten intervals must stay under for a topic to have a rate
STAMP_AHEAD = 0.020  # [s] that a stamp may be after its log time
STAMP_DELAYED = 1.0  # [s] from stamp to log that no driver takes
DELAYS_APART = 0.2  # [s] between the delays of two topics
PEERS_APART = 0.060  # [s] between the delays of one kind of images of several cameras
DELAYS_DRIFT = 0.020  # [s] over the log
PAUSED_TOGETHER = 0.8  # of the shorter of two pauses that both share
ENDS_EARLY = 1.0  # [s] before the last image; or after the first of all topics, before the last
ENDS_MUCH = 0.1  # of the log
FILES_APART = 60.0  # [s] between the logs of one session

# Joint states: units, limits and kinematics
ANGLES_FAR = 0.5  # [rad] beyond the limits, and beyond a whole turn: not the limits of another joint
STATES_SHARE = 0.5  # of the states that must be there
STATES_PAUSE = 86_400.0  # [s] between states; beyond it the clock is another
DEGREES_SLACK = 0.1  # [rad] by which degrees may exceed the limits
POSES_COMPARED = 200  # that are compared, spread over the log
POSES_POSITION = 0.005  # [m] within which poses agree
POSES_ROTATION = 0.02  # [rad] within which poses agree
LINK_TRAVEL = 0.05  # [m] or, of rotation, [rad] that a link must move to tell a tool from a wrong robot
POSES_LEVER = 0.1  # [m] lever by which a rotation counts against a position
LIMIT_SLACK = 0.01  # [rad or m] by which a state may exceed a joint's limit

# The arm: depth images against forward kinematics
ARM_NEAR = 0.10  # [m] beyond its surface: something else is seen in its place; nearer by more: it is hidden
ARM_COVER = 0.02  # [m] by which covering spheres may stand before the surface
ARM_OFFSET = 0.03  # [m] of the measured surface from the predicted one, in the median
ARM_SEEN_THROUGH = 0.25  # of the arm's pixels
ARM_MISFIT = 0.025  # [m] mean of the pixels' offsets, each cut at `ARM_NEAR`
ARM_PIXELS = 100  # of the arm, at least
ARM_CLOSE_NS = 100_000_000  # [ns] between a frame and the joint states around it
ARM_ROWS = 60  # of an image
SWAPPED_FRAMES = 8  # frames that exchanged joints are tried on
SWAPPED_MISFIT = 0.4  # of the misfit that may remain
ARM_SPREAD = 0.04  # of depth over predicted depth
ARM_SCALE = 0.04  # departure of that scale from 1
TIME_REACH = 0.32  # [s] clock offsets that are tried on either side
TIME_STEP = 0.04  # [s] between them, at first
TIME_FINE = 0.02  # [s] between them, then
TIME_CHEAPER = 0.9  # of the misfit four steps away that the best offset must reach
TIME_SAVED = 0.0005  # [m] of the misfit four steps away that the best offset must save
TIME_OFFSET = 0.030  # [s] between the clocks of cameras and robot
TIME_ERROR = 0.010  # [s] of an offset found by the arm; on the simulated log 0, 80 and 100 ms are found within 7
TIME_OWN = 0.85  # of the misfit at the offset of most cameras, for a camera to have an offset of its own

# Views: depth images of several cameras against each other
VIEWS_RANGE = (0.2, 6.0)  # [m] of depth that is compared between views
VIEWS_ROWS = 80  # of an image that are looked at
VIEWS = 12  # of a camera
VIEWS_PAIRS = 40  # that are compared
VIEWS_POINTS = 1000  # of a view that are laid into others
VIEWS_LANDED = 1000  # points of all pairs
VIEWS_BASELINE = 0.02  # [m] between two views that are compared
VIEWS_FIT = 0.01  # of the depth, from a surface, within which a point fits it
VIEWS_FEW_LANDED = 0.6  # of the most: with fewer, the share that fits is taken of as many
VIEWS_SAME_FIT = 0.9  # of the best share of points, for another to be as good
VIEWS_OTHER_SCALE = 0.08  # of its logarithm, that a scale must differ from 1 to be named
VIEWS_TRUSTED = 0.2  # of the most points that land: with so many that fit, depths are taken as they are
VIEWS_UNUSUAL = 0.75  # of the largest usual depth: beyond it views that do not meet are doubtful
VIEWS_FAR = 10.0  # times the depth, by which cameras of a still scene may be apart
VIEWS_BESIDE = (1 / 1.5, 1.5)  # of the best scale: where one of them fits as well, the scale is not determined
VIEWS_MORE_FIT = 0.07  # by which more points must fit
VIEWS_TIMES_FIT = 1.12  # times as many points must fit
VIEWS_LEAST_FIT = 0.4  # of the points that must fit then
MOVE_WIDTHS = (0.05, 0.05, 0.04, 0.03, 0.03, 0.03, 0.03)  # [m] of a residual that counts, by round
MOVE_WIDE = (0.15, 0.15, 0.12, 0.1, 0.08, 0.06)  # before them, where a camera is far off
MOVE_FLAT = 2e-3  # eigenvalue (of the mean normal equation) below which a direction is not seen
MOVE_CUT = 0.015  # [m] of a residual, in the cost
MOVE_CHEAPER = 0.04  # share of the cost that a move must save
MOVE_METRES = 0.012  # [m] from which a move is named
MOVE_DEGREES = 0.8  # [deg] from which a move is named
MOVE_GOOD_SHARE = 0.45  # of the points that must lie within 1 % of the depth after a move

# Clocks of cameras and robot: motion in images against motion of the arm
MOTION_DEPTH_STEP = 0.05  # [m] at which the change of a pixel's depth counts in full
MOTION_COLOR_STEP = 64.0  # [grey levels] likewise
MOTION_FRAMES = 300  # of a camera; later ones are not looked at
MOTION_FIXED = 1e-3  # [m, rad] within which a camera stands still
MOTION_INTERVALS = 10  # between frames
MOTION_LEAST = 0.02  # [rad or m] that a joint must move
MOTION_STATES = 1000  # states by which a joint is seen to move
MOTION_CAMERAS = 2  # that are compared pixel by pixel, those in which most changes
OFFSET_REACH = 2.0  # [s] searched on either side
OFFSET_SHARE = 0.25  # of the log that may be searched on either side
OFFSET_STEPS = 6  # offsets tried per time between frames
OFFSET_CORRELATION = 0.6  # of summed motion
PIXEL_CORRELATION = 0.3  # of motion pixel by pixel, which noise and the background lower
OFFSET_LEAD = 0.05  # over the next best peak
PIXEL_ERROR = 0.15  # of the time between frames: found on the simulated log, per camera (docs/replay.md)
OFFSET_SUM_ERROR = 1.0  # likewise

# Exposure: images of one camera against each other
EXPOSURE_FRAMES = 8  # of a camera
EXPOSURE_RATIO = 0.05  # by which one image is brighter than another, from which on that is named
EXPOSURE_BANDS = 8  # of rows, each with an exposure of its own
EXPOSURE_UNEVEN = 0.20  # by which one band of an image is brighter than another: 13 % at most without flicker
EXPOSURE_EXPLAINED = 0.5  # of what bands differ by, that gains of images leave: shelf 0.4, office 0.65, gloss 0.83
EXPOSURE_LEFT = 0.5  # of what views differ by, that bands leave: 0.7 to 0.9 in real recordings without flicker
