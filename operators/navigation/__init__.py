"""Navigation of a small differential-drive robot among walls, furniture and people: arrays in, velocities out.

The parts, from the floor up: `lattice` (a raster on the world), `obstacles` (what the lidar has seen, remembered),
`distance` and `costmap` (how near things are, what that costs), `search` (time to the goal from everywhere), `window`
(the best arc for the next seconds), `people` (who will be where, and what passing them costs), `presence` (who stands
where the lidar is blind), `motion` (where the robot will be when a command takes effect), `navigator` (all).
"""
