"""Scene files of a linear screen, a circular screen and a feeder, with the numbers of a data sheet."""

_HEAD = """# Numbers are in SI units; text can have any unit of the same dimension.
# Points (x, y) are in m from the centre of mass of the body: x to the right, y up.
[machine]
kind = "plane_body"
"""

_GRAVITY = """
[effects]
gravity = true              # weight of the unbalances: a motor that is too weak does not lift them
"""

SCREENS = {
    "linear_screen": """# A linear screen: two motors turn in opposite directions, and the deck throws at 45 degrees.
"""
    + _HEAD
    + """mass = 2600.0               # kg, with the motors, without the material
inertia = 3800.0            # kg m^2, about the centre of mass

[[machine.supports]]        # two coil springs at the feed end; the natural frequency up is about 3 Hz
at = [-1.6, -0.3]
stiffness = ["280 N/mm", "460 N/mm"]    # horizontal, vertical
damping = [2000.0, 2500.0]              # N s/m
# angle = "0 deg"           # turns both springs anticlockwise

[[machine.supports]]        # two coil springs at the discharge end
at = [1.6, -0.3]
stiffness = ["280 N/mm", "460 N/mm"]
damping = [2000.0, 2500.0]

[[exciters]]                # direction of throw: from the centre of mass to the midpoint of both axes, here 45 degrees
at = [0.46, 0.81]
direction = 1               # anticlockwise
unbalance = { force = "50 kN", at = "1000 rpm" }    # centrifugal force from the catalogue, or "4.56 kg m"
[exciters.drive]
kind = "induction_motor"    # 3 kW, six poles, 50 Hz
speed = "1000 rpm"          # synchronous
breakdown_torque = 80.0     # N m
breakdown_slip = 0.35
inertia = 0.6               # kg m^2, of the rotor with its unbalances

[[exciters]]
at = [0.81, 0.46]
direction = -1              # clockwise
unbalance = { force = "50 kN", at = "1000 rpm" }
[exciters.drive]
kind = "induction_motor"
speed = "1000 rpm"
breakdown_torque = 80.0
breakdown_slip = 0.35
inertia = 0.6
"""
    + _GRAVITY,
    "circular_screen": """# A circular screen: one shaft through the centre of mass moves the deck on circles.
"""
    + _HEAD
    + """mass = 1900.0               # kg, without the unbalance and the material
inertia = 1700.0            # kg m^2, about the centre of mass

[[machine.supports]]        # springs at the feed end
at = [-1.3, -0.1]
stiffness = ["250 N/mm", "350 N/mm"]    # horizontal, vertical
damping = [1800.0, 2000.0]              # N s/m

[[machine.supports]]        # springs at the discharge end
at = [1.3, -0.1]
stiffness = ["250 N/mm", "350 N/mm"]
damping = [1800.0, 2000.0]

[[exciters]]
at = [0.0, 0.03]            # the shaft, in the drawing of the side wall
direction = -1              # clockwise: with the flow of material to the right
unbalance = { force = "70 kN", at = "900 rpm" }
unbalance_mass = 120.0      # kg, added to `mass`, at the shaft
[exciters.drive]
kind = "induction_motor"    # 7.5 kW with a belt; speed and torque at the shaft
speed = "900 rpm"
breakdown_torque = 200.0    # N m
breakdown_slip = 0.3
inertia = 1.1               # kg m^2, of shaft, unbalance, pulleys and motor, at the shaft
"""
    + _GRAVITY,
    "feeder": """# A feeder: two motors under its rear end turn in opposite directions, and the trough throws at 25 degrees.
"""
    + _HEAD
    + """mass = 400.0                # kg, with the motors, without the material
inertia = 160.0             # kg m^2, about the centre of mass

[[machine.supports]]        # rear springs
at = [-0.8, -0.15]
stiffness = ["80 N/mm", "126 N/mm"]     # horizontal, vertical
damping = [300.0, 400.0]                # N s/m

[[machine.supports]]        # front springs
at = [0.8, -0.15]
stiffness = ["80 N/mm", "126 N/mm"]
damping = [300.0, 400.0]

[[exciters]]                # the midpoint of both axes lies opposite to the direction of throw, at 25 + 180 degrees
at = [-0.607, -0.118]
direction = 1               # anticlockwise
unbalance = { force = "10 kN", at = "1500 rpm" }
[exciters.drive]
kind = "induction_motor"    # 0.75 kW, four poles, 50 Hz
speed = "1500 rpm"          # synchronous
breakdown_torque = 14.0     # N m
breakdown_slip = 0.3
inertia = 0.03              # kg m^2, of the rotor with its unbalances

[[exciters]]
at = [-0.481, -0.39]
direction = -1              # clockwise
unbalance = { force = "10 kN", at = "1500 rpm" }
[exciters.drive]
kind = "induction_motor"
speed = "1500 rpm"
breakdown_torque = 14.0
breakdown_slip = 0.3
inertia = 0.03
"""
    + _GRAVITY,
}
"""Scene files with comments, by their names in `jaxvib new`."""
