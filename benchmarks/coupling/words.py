"""The words of docs/coupling.md that no measurement changes: the scheme, what tables mean, what contact cannot do."""

HEAD = """# Contact between grains and bodies

How sand and MuJoCo bodies exchange momentum, and what was measured of it. Made by `make coupling` from \
`benchmarks/results/coupling_*.json`; not written by hand. Scenes and measures are in `benchmarks/coupling`; tests in \
`tests/coupling` run them small; the recordings of the pictures go to `coupling_out/*.rrd`, for `mpm-env replay FILE \
--view`. f32, native kernels, sand of E = 1 MPa and 35 degrees, unless said. Bands that are \
missed stay in the tables.

"""

SCHEME = """## The scheme

At every substep one equation is solved in the joint velocities of all bodies: the mass matrix that MJX's integrator
uses, the contact law of every grid node and grain near a body (inelastic, Coulomb friction, adhesion where asked for),
and MuJoCo's own laws of rigid contacts, joint limits, dry friction and equalities (`coupling/exchange.py`,
`coupling/constraints.py`). What grains gave is summed over the substeps and handed to MJX, which so ends the rigid step
where the grains last saw the bodies.

- **Rigid constraints.** A time t into a rigid step, MuJoCo's constraint laws hold for the mean acceleration since its
  start: at the end they are MJX's own. Each Newton step of the exchange takes them to the full, and MJX's solver starts
  from the result. Elliptic friction cones are refused: choose `cone="pyramidal"`.
- **Gaps.** A grid node has mass from 1.5 cells before the grains' surface on. From its share of the mass it would have
  with grains all around, the node tells how far away their surface is, and meets the body when that gap closes.
  Gaps under a quarter of a cell count as none.
- **Thin tools.** `push_out: false` looks at grid nodes only, costs least, and is refused for geoms thinner than 2.5
  cells, since through 2 cells 3 % of the sand passes. `push_out: true`, the default, also stops every grain that
  entered a body and puts it back to the surface.
- **One way.** `two_way: false` moves bodies as if there were no grains and solves nothing; wrenches are still told.
- **Reports.** `State.contact` tells each rigid step's deepest grain, peak force, momentum that did not close, share of
  the equation left, and how far MJX's end was from the one that grains saw; all but the force have a health bit.

"""

LIGHT = """\
Bodies a hundredth as dense as sand, but for the arm and the gate, which weigh 20 g. `Noise` is the rms of the force
about its mean at the end, over the mean; `astray` is how far MJX ended a step from where the grains saw the body;
`unpaid` is the share of the exchanged impulse by which what grains got and what bodies got differ. The negative
controls are the same contact law at the velocity without contact: explicit, its impulses paid at once; staggered,
paid at the rigid step's end.

MuJoCo's rigid contacts are as soft as a body is light: with its default a box of foam is pressed far into a floor by
the sand on it. The floor and the wall here have `solimp=".9999 .9999 .001"`, which holds it.

"""

DROP = """\
20 x 20 x 10 cm, it falls 5 cm on 20 cm of sand above a rigid floor. How high it rests counts from the sand's first
surface to the box's underside. The energy is that of sand and box together.

"""

PENETRATION = """\
Walls against Rankine's passive pressure, blades against the fundamental earth-moving equation, plates against
resistive forces, dropped balls and cones against the laws of impact. Each in the sand of its experiment: of 2 MPa for
walls and blades, 30 degrees for plates, 24 degrees for balls.

"""

LIMITS = """## Limits

With the default band, a surface loses part of its adhesion where its face lies three quarters of a cell beyond a
plane of nodes: scenes with adhesion want `contact_band: 0.5`, which loses less (`tests/coupling/test_adhesion.py`).
A foam box may leave a substep of its impact unsolved, which a health bit tells. Contact of a block in a notch comes
and goes, and a block of sand there creeps. Rigid contacts are as hard as their solimp. The thickness of a mesh is
that of its thickest part: a thin wall on a thick mesh is not refused. Where grains of two densities meet a body, gaps
are told as for the lighter ones, so the heavier touch early.

Sand that a tool stirs for long becomes denser: grains that entered the tool are put back to its surface between
others, and no strain tells of it. A small bed lost 2 % of its volume with each sweep to and fro
(`docs/validation.md`), and 0.3 % where the grid alone stops grains (`push_out: false`), which thick tools allow.
"""

SCENES = {
    "buried": "box buried flush",
    "at the wall": "box between sand and a rigid wall",
    "on the floor": "box under sand on a rigid floor",
    "squeezed": "two boxes squeeze sand with 10 N each",
    "light arm": "arm pressing into the bed, told to move",
    "at the limit": "gate that sand presses against its joint limit",
}

SCHEMES = {"together": "solved together", "explicit": "explicit (control)", "staggered": "staggered (control)"}

MEASURES = {  # how a number is called
    "fastest": "fastest, m/s or rad/s",
    "noise": "noise of the force / mean",
    "astray_cells": "astray, cells",
    "unpaid": "unpaid",
    "rebound": "rebound / impact",
    "rms_m_s": "rms speed at the end, m/s",
    "weight": "force / weight at the end",
    "rests_cells": "rests above the surface, cells",
    "rise": "largest rise of all energy / impact's",
    "inside_cells": "deepest grain inside, cells",
    "scatter_cells": "scatter over places of the grid, cells",
    "leaked": "passed / swept",
    "over_reference": "force / the reference's",
    "ratio": "density ratio",
    "impulse_off": "impulse, off by",
    "way_off": "way, off by",
}

REFINED = """\
Half a second in plane strain, cells of 25 mm: a box as dense as sand falls 5 cm on a bed; a heavy arm presses its
paddle into one. Time is cut into rigid steps of 16, 4 and 1 substeps, and of 16 substeps half as long. `Off` is the
share by which the sand's impulse and the body's way differ from those of the first row.

"""

COST = """\
CPU time of rigid steps with the bucket in the bed (`bucket_dig`) beyond that of the same grains' substeps without any
body, over the latter; alone and in a batch of environments; least and most of five rounds in brackets.
`docs/performance.md` has the stages it comes from.

"""
