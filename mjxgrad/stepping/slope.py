"""Numbers of the slope's rule, which both engines have: `engines.events` and `engines.flight` say what they do.

They need no JAX: processes that know nothing of it import them.
"""

# Events.
LEAST_WIDTH = 0.06  # half a window, of the impedance's width
USUAL_WIDTH = 1e-3  # m or rad; wider impedances, of soft limits, reach states that come to no surface
SMALLEST = 1e-6  # half a window (m or rad)
STIRRED = 4.0  # steps of travel, beyond which a surface is not near
STAGES = 1.2  # travels that a window of Runge-Kutta spans: with 1 a tenth is missed on hoppers, with 2 the mean is further off
NO_JUMP = 0.01  # impedance from which force begins without a jump worth the name, so that small differences see it all
FARTHEST = 10.0  # gaps that anything may move to change one gap alone; rows that need more are no events of their own

# Pairs. Let go after one step that is alike, a rolling ball's derivatives scatter twice as far. Of a falling arm that bounces
# twice, four keep both motions until the second bounce, which then is not averaged over its own phases.
NUM_ALIKE, ALIKE = 3, 0.05
FAR = 10.0  # times the distance at first; a falling arm that bounces twice is off with 5
LONGEST, LONGEST_OF_STAGES = 100, 2  # steps; of Runge-Kutta few
BESIDE = 0.5  # of an event's window, up to which a pair may lie to one side of it; a falling arm is off without
TRAVEL = 10  # steps over which a difference of velocities is one of positions
