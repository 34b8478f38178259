"""Numbers of the method that are fixed on purpose. They are not settings: each was measured, or follows from the
method or from what is compared, and a run with another one could not be compared with the rest. A unit stands in
brackets before what a number decides; without one it is a share, a factor or a count.
"""

# Reading a recording: poses, joint states and clocks
POSE_TOLERANCE_NS = 20_000_000  # [ns] before the first and after the last pose of a trajectory
TF_GAP_NS = 1_000_000_000  # [ns] samples farther apart bracket no pose, unless nothing moved between them
TF_STILL_POSITION = 1e-3  # [m] between two samples of what did not move
TF_STILL_ROTATION = 2e-3  # largest change of a rotation entry of what did not move
JOINTS_GAP_NS = 200_000_000  # [ns] a joint state older than this says nothing about a frame
FRAMES_PER_STEP = 256  # frames of a scene without a clock that are taken in together; 640x480: 6 MiB each
SAME_MOMENT_NS = 20_000_000  # [ns] frames of one time step are at most so far apart
PLAUSIBLE_DEPTH = (0.05, 20.0)  # [m] least and largest median of a depth image's valid pixels
UNIT_DEPTH = (0.15, 8.0)  # [m] the same where a unit is guessed by it
UNIT_APART = 0.02  # of the depth, by which cameras are apart whose places have its unit
UNIT_BASELINE = 0.05  # [m] of cameras that are so far apart views tell whether depth has the unit of the places
FLOAT_DEPTH_UNIT = 1e-4  # [m] of a count, tried for depth that was not recorded as counts
FLOAT_DEPTH_ERROR = 1e-6  # [m] of rounding to such counts at most, else the floats themselves are stored
CLOUD_RESIDUAL = 0.5  # [px] that 95 % of a cloud's points lie from where its pinhole camera has them, at most
CLOUD_POINTS = 40  # fewest points that such a camera is fitted to
REGISTERED_SHARE = 0.25  # of an undistorted image that its lens saw, at least
FARTHEST_RAY = 20.0  # from the optical axis, at a depth of one: 87 degrees
IMAGES_STEADY = 0.25  # largest departure from the period, in periods, of an interval that counts as steady
IMAGES_GAP = 1.5  # [periods] from which on an interval of images is a gap
IMAGES_FEWEST = 5  # intervals that a rate is judged by
IMAGES_BACK_NS = 1_000_000_000  # [ns] so far behind an earlier stamp the clock went back
IMAGES_FEWEST_BACK = 3  # stamps so far behind that make it a clock that went back
STATES_STILL = 1e-3  # [rad or m] a joint that moves by no more stands still
STATES_BRIDGED = 0.5  # [s] at most between states of another topic that a position is interpolated over
STATES_CONFLICT = 1e-6  # [rad or m] by which states of one stamp may differ
STATES_SPEED_RATIO = 3.0  # of logged to differentiated speeds beyond which their units differ
STATES_SPEED = 0.05  # [1/s] from which on speeds are compared
STATES_COMPARED = 5000  # states at most whose speeds are compared, spread over the log
STATES_GAP_PERIODS = 5.0  # a step of the stamps this many times the usual one is a gap
STATES_GAP_SECONDS = 0.1  # [s] and of at least this length
STATES_PERIOD_SAMPLES = 20  # states over which the period is measured
STATES_POSITION_SAMPLES = 2  # states before and after that a velocity is fitted to
STATES_CLOCK_SAMPLES = 50  # states before and after that a stamp is smoothed over
STATES_CLOCK_GAIN = 0.05  # of a stamp's deviation by which the clock that counts states follows
CLOCK_OTHER = 1.0  # [s] between stamp and logging above which they are two clocks
CLOCK_STEP = 1.0  # [s] by which a clock was set
CLOCK_MIXED = 60.0  # [s] a step beyond which states of two clocks were joined
CLOCK_DRIFT = 0.005  # [s] of one clock against another, over the log
CLOCK_NEIGHBOURS = 5  # states over which a step must persist: one message logged late is none

# Map: the scale of a recording
SCALE_DEPTH = 0.8  # [m] of a table at arm's length, in the median: the map's lengths suit it as they are
SCALE_NEAREST = 0.5  # of the depth of the nearest tenth: nearer is noise, or what the camera carries

# Map: losses, seeding, eviction and refining (III-B, III-C)
DEAD_LOGIT = -6.9  # of a free slot: opacity 0.001, below what the rasteriser blends
OPAQUE_ENOUGH = 0.5  # accumulated opacity from which a pixel has a depth of its own
NOT_COVERED = 0.05  # accumulated opacity below which the background shows
REFINE_BLOCKS = 10  # of refining; splats go after each, and are seeded after each but the last two
CARD_LEAST_WORK = 100_000_000  # splats times pixels of a view: 3 ms an iteration on two cores, a start 1 to 3 s
SEED_LEVELS = 3  # cubes of one edge, half and a quarter of it
SEED_CROWDED = 0.7  # of the edge: nearer than this to a live splat nothing is seeded
SEED_BEND = 2.0  # weight of the thickness of a cube's points, in squared edges, beside squared colour differences
SEED_MUCH_MORE = 4  # times the pixels to seed than when the density was chosen: it is chosen again
SEED_MOST_PIXELS = 4_000_000  # to seed at a time: more are thinned, at 120 bytes each
SHELL_ITERATIONS = 0.3  # of the map's, for the shell: in a room 0.1 loses 1.5 dB, 1.0 wins 0.5
SHELL_UNMET = 0.1  # of its budget: more seeds without a slot, and a shell begins again
SEED_ASKED_VIEWS = 17  # that are asked whether they see through a pixel; all are asked of what is seeded
SEED_OVERSAMPLING = 4  # pixels drawn per splat, before those too near to each other go
EVICT_EVERY = 5  # time steps: it takes as long as a few iterations; what has no splat is a ball until then
EVICT_NEAREST = 8  # splats that are asked whether they stand for a voxel
EVICT_ASKED = 8  # splats that are looked at for each missing slot, those that show least
EVICT_NEARER = 0.3  # [m] by which a surface must be nearer to the robot's path than one given up for it
NEAREST_REACH = 0.01  # [m] about a pixel, times the scale, in which no depth may be farther than what floats
SPLIT_PARTS = 2  # Gaussians that a split one becomes (the baseline 3dgs)

# Map: occupancy, and which pixels are the robot's
NARROW_HOLE = 2.0  # [voxels] holes that are not wider are common beside edges
NARROW_GAP = 4.0  # [voxels] gaps between two objects before a far background that are not wider are common
GAP_DIRECTIONS = 3  # of four in which a gap has an object on both sides: two are common above a horizon
CONTACT_REACH = 0.02  # [m] an object so near to the robot may touch it where the robot hides it
CONTACT_THICKNESS = 0.2  # [m] of a link at most: so far behind what a camera sees of it something may touch it
WELL_INSIDE = 0.005  # [m] below the robot's surface; what nothing shows to be an object there is the robot's
MASK_SIGMAS = 2.0  # of the sensor's error that the robot's surface may explain
MASK_FAR_OFF = 0.10  # [m] a residual beyond it is something else, before or behind the robot
MASK_PIXELS = 100  # of a link, fewer say nothing of its residual
MOUNTED_MIN_VIEWS = 6  # of a camera that moves with the robot, to find what it sees of the robot in each
MOUNTED_APART = 0.02  # [m] from each other, the places of these views
MOUNTED_MAX_VIEWS = 24  # more say nothing new
MOUNTED_BLUR = 2.0  # [px] against sensor noise
MOUNTED_DEVIATION = 0.055  # median absolute deviation of a colour over the views, of 1
MOUNTED_DEPTH = 0.08  # of depths beyond the least range around a pixel: what is measured there is the world
MOUNTED_TEXTURE = 0.01  # deviation around a pixel: a flat colour without depth is the background
MOUNTED_WINDOW = 15  # [px] around a pixel
MOUNTED_AREA = 0.005  # of the image: a part that is smaller, or does not enter at the border, is chance
MOUNTED_MARGIN = 4  # [px] around what was found
MOUNTED_BACKGROUND = 0.005  # share of the pixels that shows it; fewer are noise

# Whether a recording and a map agree
POSE_JUMP = 1.0  # [m] between frames: the default of --max-pose-jump
PAIR_LIMIT = 0.03  # [m] at up to 1 m: beyond, a surface lies in two voxels, and each camera frees the other's
PAIR_SAME_SURFACE = 0.3  # [m] two views that differ by more see different surfaces: one hides the other's
PAIR_MIN_PIXELS = 200  # fewer that both views see say nothing
PAIR_MOST = 100  # of pairs of views that are compared
PAIR_ROWS = 60  # of an image that are looked at, and as many pixels of a row in proportion
PAIR_CLOSE_NS = 1_000_000_000  # [ns] poses further apart in time may be anywhere
SPLATS_ON_SURFACE = 0.6  # of the splats: 0.98 were measured on the sample, 1.00 on apc_shelf, 0.76 on office_sun3d
OCCUPIED_WITH_SPLATS = 0.95  # of the occupied voxels: 0.993 to 1; splats moved by 10 cm 0.83, of 7 s before 0.88
SAME_LENS_PIXELS = 0.5  # [px] by which focal lengths and principal points of one camera may differ
SAME_POSE_METRES = 0.002  # [m] by which two poses of one camera may differ
SAME_POSE_DEGREES = 0.2  # [deg] likewise
SAME_PICTURE_LEVELS = 3.0  # of 255, of a tile: another JPEG of the same picture differs by less than one
SAME_PLACE_METRES = 0.001  # [m] within which two cameras stand in one place
SAME_PLACE_DEGREES = 0.1  # [deg] likewise
OTHER_VIEW_CLEARLY = 3.0  # [dB] by which a photo has to be nearer another view's render than its own
SAME_MOTION_STATES = 20  # states in which a recording's clearance is compared with a truth file's
SAME_LINK = 1e-3  # [m] by which the boxes about one link of two models of a robot may differ
SAME_LINK_AREA = 0.01  # share of its surface by which a link of two models of a robot may differ
SAME_CLEARANCE = 1e-3  # [m] a truth file keeps six digits
RECORDINGS_APART_NS = 1_000_000_000  # [ns] between the times of two recordings that can still be one

# Field (III-D)
KERNEL_REACH = 8  # [l] beyond which a kernel counts as zero: 0.3 % of the sum on a plane
KERNEL_MAX_SHARE = 1e-2  # of a kernel sum that is ever left out
MARCH_STEPS = 5  # III-D: 3 to 5
SIGNED_CARE = 1e-3  # of the truncation where weights have signs: what is left of a cancelling sum needs more
VARIANCE_DIVISOR = 9.0  # III-D
LEAST_VARIANCE = 1e-6  # before the division: what float32 leaves of 1 - sum
CERTAIN_OCCUPANCY = 50.0  # log occupancy beyond which every probability is 1
VOXELS_PER_LENGTH = 2  # h = l / 2, the grid of the density
CG_ITERATIONS = 5000  # at most
CG_TOLERANCE = 1e-6  # largest residual of a row, of the smallest value asked for
CG_FLOOR = 1e-13  # of the largest value asked for: what float64 can do
CG_MAX_SPREAD = 16.0  # of a group's log values: beyond, the smaller drown in the rounding of the larger
ROUGH_LENGTH = 10.0  # [m] from which on float32 costs the Gaussian kernel's distance 0.2 mm; at 100 m 5 cm
MAX_RADIUS_SPREAD = 30.0  # of the radii: the largest over the smallest above zero
NEAR_ONE = 0.05  # by which a gradient's length may differ from 1
FAR_GRID = 1.0  # [m] a grid whose every cell is farther from the splats than this is warned about
COMPARED_CELLS = 200_000  # a larger grid is compared with the truth at this many cells, drawn with the seed

# Control (III-E): barriers, limits and what is known of the space about the arm
IMMOVABLE_ROW = 1e-9  # [m/s] a row that the fastest allowed motion changes by less cannot be acted on
BRAKING_SHARE = 0.5  # of what a row alone could brake with; 1 lost up to 6 mm where several rows brake at once
STEP_SCALES = (0.5, 0.25, 0.125, 0.0625)  # of a step that turns out worse than its rows promised; then none
WITHIN_SHARE = 0.01  # of `promise_tolerance`, for a sphere that is within its margin
MULTIPLIER = 1e-4  # above which a row counts as intervening; an idle row's ends below 1e-6
MAX_HALVINGS = 10  # of an interval whose clearance is certified
HALVED_DOWN_TO = 5e-4  # [m] of travel: shorter pieces are not halved any more
MOTION_WINDOW = 0.05  # [s] over which a motion is averaged, so that an encoder's steps are not taken for speed
ENCODER = 1e-3  # [rad or m] that each position may be off
NEAR_EVERY_NS = 200_000_000  # [ns] between states that are looked at: cameras that stop are stale five times as late
NEAR_APART = 0.01  # [m] a point of a shell is at least so far from every other sphere of the arm
NEAR_NEW = 0.05  # [m] from the arm at the first state: space that the motion comes to
NEAR_FRESH_SHARE = 0.75  # of the seen points; the arm itself hides up to a quarter of its shell for seconds
NEAR_BLIND = 0.9  # of the new points of a sphere's shell never seen: it comes to the unknown
NEAR_FEWEST = 5  # such points, at least
UNWATCHED_NS = 500_000_000  # [ns] without depth from about the arm: two frame sets of a slow recording
UNWATCHED_AFTER_NS = 10_000_000_000  # [ns] after a motion, in which the next depth is waited for
UNWATCHED_APART_NS = 20_000_000  # [ns] between postures that are held against the next map
NEAR_LEAST_SHARE = 0.05  # of the shell: fewer points say nothing
MAX_RESUME = 100.0  # [m] a zone wider than any hall would hold the arm for ever
ZONE_RESOLUTION = 0.01  # [m] a person this near to a box counts as inside
NEXT_SCENE_NS = 500_000_000  # [ns] after a motion, in which the next scene is looked for
GOLDEN_TOLERANCE = 1e-6  # [rad/s] of --golden-tolerance: steps.csv keeps nine digits; another machine needs more

# Planner (IV)
SHORTCUT_WORTH = 1e-3  # [rad] that a shortcut has to save
STILL_ROW = 1e-9  # [m] a row that an edge does not move is taken to lose this much
SHORTEST_EDGE = 1e-9  # [rad] that the search for where an edge stops being free goes down to
FRAME_SPACING = 0.05  # [rad] of the samples that the speed of a frame is looked at
START_ROOM = 1e-3  # [m] left to move in where the start or goal stands within a margin
GOAL_GUESSES = 2  # per goal posture that is looked for
GOAL_STEPS = 30  # of a guess: with 100, a fifth more guesses end at the pose, in 2.6 times the time
GOAL_DAMPING = 1e-4  # of the squared Jacobian's diagonal, as it begins; grows where a step does not help
GOAL_LONGEST_STEP = 0.3  # [rad] of a step, in any joint
GOAL_SHARE = 0.1  # of the goal's tolerances that a posture keeps to
GOAL_DISTINCT = 0.05  # [rad] that two postures differ by at least, in some joint

# Simulation: how another arm is led through the scene
SIMULATED_GUESSES = 12  # random postures that the search for a waypoint begins with
SIMULATED_TURNS = 8  # of the tip about its own axis that are tried
SIMULATED_POSTURES = 2  # kept of each turn
SIMULATED_NEARER = 0.85  # of the distance from the base, where an arm does not reach a waypoint
SIMULATED_NEARINGS = 10  # times: to a fifth of it
SIMULATED_SAMPLES = 25  # of a leg whose clearance is looked at
SIMULATED_CLEARANCE = 0.05  # [m] that a leg should keep: twice the margin and what a map errs by
SIMULATED_SHORTFALL = 20.0  # [rad] longer, a leg without any clearance
TASK_CLEARANCE = 0.03  # [m] that a way through a drawn environment keeps: the margin, and what a map errs by
TASK_SPARE = 0.002  # [m] more of start and goal
TASK_ENVIRONMENTS = 50  # drawn until one has a way
TASK_GUESSES = 24  # random postures that the search for a place begins with
TASK_POSTURES = 4  # at a goal
TASK_APART = 0.20  # [m] of start and goal

# Robot: its spheres, and what they leave uncovered
DEFICIT_GAP = 1e-5  # [m] between the proven and the found deficit
COVERED_EDGE = 2e-3  # [m] longest edge of a triangle that is counted as covered or not by its middle
COVERED_COARSE = 0.02  # [m] the same of areas that a replay does not report; the deficit is as exact as ever
CYLINDER_SIDES = 96  # of the prism that stands for a cylinder: 0.05 % of its radius
SPHERE_ROUNDS = 4  # of splitting an octahedron's faces: 2048 stand for a sphere, 0.3 % of its radius
SELF_POSTURES = 2000  # random ones by which a pair of links is judged
SELF_TOUCHING = 100  # random ones, in all of which links overlap that no posture parts
SELF_OFTEN = 0.2  # of them in which a pair of links keeps less than the margin: it is given one that it can keep
SELF_KEPT = 0.1  # of them may keep less than that
SELF_SHARE = 0.5  # of the largest gap of two links: nearer they are near each other, however small the gap
SELF_TOLD = 0.5  # of the postures that are not near must keep a margin that excludes the near ones
SELF_ROUNDING = 1e-6  # [m] by which gaps of a pair that does not change may differ
LEAST_OVERLAP = 1e-6  # [m] said of links whose surfaces cross without a vertex inside
NEVER_MARGIN = 0.02  # [m] a pair that comes nearer than this in a sample is kept, though it never collides there
FIT_MIN_PATCH = 2e-3  # [m] longest edge of a patch, at the least
FIT_BISECTIONS = 10  # of the lattice spacing, and of t, the largest protrusion
FIT_ROUNDS = 12  # of assignment and recentring
FIT_STEPS = (0.5, 0.25, 0.125, 0.0625)  # of the lattice spacing, tried about each centre
FIT_TIE = 0.05  # a candidate within this share of the best gain may be picked
DEFAULT_SPHERES = 64  # of --num-spheres: as many as the public sets for the Panda have

# Verdict
SLIGHTLY_UNDER = 1e-3  # [m] under a margin that solver, rounding and a map that is still being fitted may leave
STATIC_CHANGE = 0.01  # [m] by which a fixed sphere must come nearer to count: splats move by less about a surface
MOUNTED_CHANGE = 0.03  # [m] the same of one that stands near its mount, whose map grows in the first frames
LIMIT_EXCEEDED = 1.01  # of a velocity or acceleration limit
CLOCKS_APART = 0.05  # [s] beyond the estimate's own uncertainty: at 0.5 m/s an arm is then 25 mm elsewhere
BLIND = 0.09  # of the moving spheres: without a fault in a tenth of the runs more come to space never seen
SOME_UNSEEN = 1 / 3  # of the points about the arm: below, a few spheres in the shadow of a seen thing do not count
UNSEEN = 0.47  # of the points about the arm: three cameras leave 0.02 to 0.3; at 0.48 a lone one hid a thing
COARSE_VOXEL = 0.025  # [m] of a map beside a robot: its gaps and splats grow with it, the margin does not
MISPLACED = 0.005  # [m] of the robot's own surface, in the median: 0.1 mm on a calibrated rig
SPHERE_CELL = 0.02  # [m] to which the places of spheres are rounded
FEWEST_STRETCHES = 2  # a single one allows a confidence of one half
HELD_OUT_EDGE = 0.03  # of its depth: a pixel that differs more from a neighbour may lie between two surfaces
FREE_TOLERANCE = 0.005  # [m] behind the measured depth that still counts as seen free: the noise of a depth camera
FREE_PROBES = (0.3, 0.6, 0.9)  # of a ball's radius; an object thinner than the gaps between them may be missed
FREE_DIRECTIONS = 96  # of each ball
ROBOT_MARGIN = 0.03  # [m] about the robot's spheres in which a measured point may be the robot itself

# Poses put right by what views see of each other; lengths [m] are of a table at arm's length
CALIBRATION_NOISE = (0.0005, 0.0015)  # [m], [1/m] of a depth: what every sensor errs by, and with the depth's square
CALIBRATION_TILES = (6, 8)  # rows and columns of an image; residuals of one part of it err alike
CALIBRATION_CREASE = 3.0  # times what a depth may err by, that it may stand out of its neighbours on one surface
REFINE_ROWS = 240  # of an image that is looked at
REFINE_BLUR = 0.6  # [px] of the small image, the sigma by which grey values are smoothed
REFINE_POINTS = 6000  # of a view; every second one is laid on others, the rest says how well that went
REFINE_ASKED = 32  # nearest views that are asked how much they share
REFINE_NEIGHBOURS = 12  # of these, those that a view is laid on
REFINE_OVERLAP = 0.1  # of a view's points that land on the surface of another, at least
REFINE_ALIKE = 0.7  # cosine between the normals of two views of one surface, at least
REFINE_WIDTHS = (60.0, 40.0, 25.0, 15.0, 10.0, 8.0, 6.0)  # sigmas from which on a distance does not count, by round
REFINE_ROUNDS = 12  # more of the last width, at most
REFINE_STILL = 2e-5  # [rad] or [m]: a round that moves by less is the last
REFINE_COLOR_FROM = 25.0  # the width from which on grey values count
REFINE_COLOR = 0.03  # what grey values in [0, 1] err by
REFINE_CUT = 3.0  # times as much: from there on they do not count
REFINE_GAINS = (0.7, 1.4)  # between the exposures of two images
REFINE_FEWEST = 50  # points that a pair of views is compared by
REFINE_PRIOR = (0.03, 0.05)  # [rad], [m] by which recorded poses are taken to err
REFINE_FARTHEST = (0.15, 6.0)  # [m], [deg] that a pose is put right by, at most
REFINE_GAIN = 0.03  # of the median distance between views: a smaller gain is none
EXPOSURE_BLUR = 1.5  # [px] of the small image, the sigma by which colours are smoothed
EXPOSURE_NEAR = 4.0  # sigmas of the depth within which two views show one surface
EXPOSURE_LEVELS = (12.0, 243.0)  # of 255, between which a colour tells of the exposure
EXPOSURE_ERROR = 0.01  # of the logarithm of a ratio of two views, however many pixels it is of
EXPOSURE_PRIOR = 0.3  # of the logarithm of a gain
EXPOSURE_GAIN = 0.01  # of the logarithm of the largest gain: below it colours stay as they were

# Scores
BANDS = ((0.0, 0.02), (0.02, 0.05), (0.05, 0.10), (0.10, 0.20))  # [m] true distance
CLEARANCE_NEAR = 0.10  # [m] true clearance below which a state takes part in the comparison
MAP_ALLOWANCE = 0.01  # [m] beyond the median splat radius by which a clearance or the exact field may be off
PROBABILITY_NEAR = 0.05  # [m] where a probability is neither 0 nor 1
IN_FRONT = 0.03  # [m] by which a rendered depth stands before the measured one: more than noise and radius
SSIM_WINDOW = 11  # [px] of the Gaussian window
SSIM_SIGMA = 1.5  # [px] of that window
SSIM_C1 = 0.01**2  # of images from 0 to 1
SSIM_C2 = 0.03**2  # likewise
SSIM_BOX = 7  # [px] the window of scikit-image's default
SSIM_BOX_RANGE = 2.0  # what it takes for images of floats, [-1, 1], when no range is given
CLOUD_DISTANCE = 0.020  # [m] of DTU's evaluation: what is farther off counts in a share, not in a mean
CLOUD_SPACING = 0.0002  # [m] of DTU's evaluation
CLOUD_NO_OVERLAP = 0.001  # share of two boxes' volume: they do not meet
CLOUD_GOOD_OVERLAP = 0.05  # share of two boxes' volume: their units agree
COMPARED_SPLATS = 10_000  # IV-A: what both methods begin with, and the budget of ours
COMPARED_FIRST = 300  # of ours: on the first time step, the rest refines
EXPORT_MIN_PSNR = 80.0  # [dB] of a format that rounds to float32 alone; measured: 107 and more, or the same
EXPORT_DIFFERENCE = 3 / 255  # the last bit can take a splat across the renderer's cut-off of 1/255
EXPORT_MAX_COLOR = 1e4  # of a sensor's 0 to 1, or of a harmonic; from 1e6 on an isotropic PLY looks otherwise
EXPORT_VIEWS = 4  # around the scene

# Calibration: cameras against each other and the robot
STATES_CLOSE_NS = 100_000_000  # [ns] between a frame and the joint states around it
CALIBRATION_FACING = 0.2  # cosine between a ray and the normal: more slanted surfaces are measured badly
CALIBRATION_ALIKE = 0.5  # cosine between the normals of two views of one surface, at least
CALIBRATION_BEND = 0.005  # of the depth, above which neighbouring pixels of a rendered link have an edge between them
CALIBRATION_MOUNT = 2e-3  # [m], or of rotation entries, within which a camera rides on a link
CALIBRATION_ARM_POINTS = 300  # of a frame
CALIBRATION_PRIOR = (0.5, 0.5, 0.05, 0.5)  # [rad], [m], of depth scale and [m] of bias, [s]: very wide
CALIBRATION_STEP = 0.2  # [rad], [m] or [s] that a round moves by, at most
CALIBRATION_STILL = 5e-5  # [rad], [m] or [s]: a round that moves by less is the last
CALIBRATION_ROUNDS = 30  # at most, after the widths have narrowed
CALIBRATION_ROWS = 240  # of an image that is looked at
CALIBRATION_ARM_ROWS = 120  # of an image in which the robot is looked for
CALIBRATION_POINTS = (4000, 800)  # of a view of a camera that stands still, and of one that moves
CALIBRATION_AVERAGED = 16  # frames of a still camera that err as if each for itself: more share a fixed pattern
CALIBRATION_BASELINE = 16.0  # times a depth's noise, between the points that a normal is taken from
CALIBRATION_ASIDE = 0.06  # [m] about the robot, that count as its own where what does not move is compared
CALIBRATION_APART = 0.02  # [m] between two views that are laid over each other
CALIBRATION_PAIRS = 300  # of views of moving cameras
CALIBRATION_PROBE = (5e-4, 1e-2)  # [m] by which what is seen is moved, to see how the residuals change
CALIBRATION_SPEED = 0.3  # [m/s] of the robot, that a clock's offset is counted with
CALIBRATION_SIGMA = 0.02  # [m] of what is seen: a direction that is less sure is not observed
CALIBRATION_CUT = 10.0  # sigmas that a residual counts as, at most, where starts are compared
CALIBRATION_FEWEST = 100  # residuals that tie two cameras, or a camera and the robot
CALIBRATION_REACHES = (0.15, 0.15, 0.15, 0.08, 0.08, 0.04, 0.04, 0.03)  # [m] of a residual that counts, by round
CALIBRATION_ROUGH = 6  # rounds at the last reach, of a first look
CALIBRATION_STARTS = 4  # beside that of the recording
CALIBRATION_AROUND = (0.06, 0.05)  # [rad], [m] that they are away, at most
CALIBRATION_TUKEY = 4.685  # sigmas from which on a residual does not count
CALIBRATION_LEAST_SPREAD = 0.5  # of what sensors err by, that residuals are taken to err by at least
CALIBRATION_FEW = (4, 60)  # frames of a camera, and pairs of views, of a first look
CALIBRATION_HOLD = 0.02  # of the weight of all residuals, by which an estimate stays near its start at first
CALIBRATION_CELL = 0.1  # of the depth, the edge of a cube in which the residuals between views err alike
CALIBRATION_DEPTH_SURE = (3.0, 5.0)  # sigmas by which scales and biases must differ from 1 and 0: all taken, and one
CALIBRATION_DEPTH_USUAL = (0.1, 0.02)  # one sigma that a scale is off 1, and [m] a bias off 0, where a camera has one
CALIBRATION_DEPTH_LEAST = 0.002  # [m] that they must change a depth by
CALIBRATION_DEPTH_MOST = (0.3, 0.1)  # by which a scale, and [m] a bias, may differ from 1 and 0
CALIBRATION_CLOCK = 0.02  # [s] within which a clock's offset must be known to be taken
CALIBRATION_OTHER = (0.01, 0.1)  # [m] of what is seen that solutions differ by; of the cost that one is better by
CALIBRATION_RIVAL = 3.0  # times the best start's cost, up to which where another start leads is looked at, too
CALIBRATION_FREED = (0.08, 0.08, 0.08, 0.05, 0.05, 0.05, 0.03)  # [m] the same, once depths are given a scale
CALIBRATION_INFLATION = 1.7  # of every sigma: what errors of 28 simulated set-ups (seeds 1000 on) were of it, rms
CALIBRATION_SCALES = (1.0, 1.1, 1 / 1.1)  # of depths, that a search begins at
CALIBRATION_UNKNOWN = 1.0  # [m] the sigma of a direction that nothing is known of
CALIBRATION_FRAMES = 30  # of a camera
CALIBRATION_BOARD_PIXELS = 2.0  # [px] that the corners of a board may be off its pose (rms)
CALIBRATION_BOARD_FEWEST = 3  # frames of a camera that show the board, and moments at which two cameras do
CALIBRATION_BOARD_VIEWS = 5  # of a board that moves with the robot, or before a camera that does
CALIBRATION_BOARD_TURN = 0.1  # [rad] about a second axis that those views must turn by (rms)
CALIBRATION_BOARD_FIT = 0.05  # [m] that the board may be off where the robot has it, its clock not known yet
CALIBRATION_BOARD_MOVED = 0.01  # [m] that a board which stands still is seen to move by, at most
CALIBRATION_BOARD_DEPTH = (0.75, 1.33)  # times what the size of its squares says, that depth may have a board away
CALIBRATION_BOARD_TOGETHER_NS = 50_000_000  # [ns] between frames that show a moving board at one moment
CALIBRATION_TRAVEL = 0.1  # [m] that some point of the robot must move, for its surface to be told from a wrong model
