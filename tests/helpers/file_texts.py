"""Texts of files that mutations start from: studies, a design, a record."""

STUDY = """
scene = "machine.toml"
samples = 12
seed = 3
chunk = 8
[axes]
"drive.speed" = { from = "200 rpm", to = "900 rpm", count = 5 }
"loads.drag" = [0.5, "1.0 N s/m"]
"machine.damping" = { from = 30.0, to = 50.0, scale = "log" }
[[measure]]
quantity = "total"
field = "machine.mass"
name = "mass"
[[measure]]
quantity = "spring_cost"
prices = [["10 N/mm", 20.0], ["100 N/mm", 55.0]]
unit = "EUR"
[[measure]]
quantity = "static_deflection"
of = 1
"""

STUDY_OF_JAMS = """
scene = "machine.toml"
tier = "leading"
[axes]
"drive.speed" = ["600 rpm", "900 rpm"]
[[measure]]
quantity = "amplitude"
mode = 3
of = [1, 2]
name = "a"
[[measure]]
quantity = "jam_frequency"
mode = 3
tolerances = { "machine.stiffness" = 0.05, "machine.damping" = 0.3 }
statistic = "worst"
samples = 4
[[measure]]
quantity = "phase"
mode = 1
"""

STUDY_OF_RUNS = """
scene = "machine.toml"
[axes]
"drive.speed" = { from = "200 rpm", to = "900 rpm", count = 3 }
"start.rate" = [0.0, "300 rpm"]
[run]
until = "0.5 s"
start = "rest"
steps = 400
[[measure]]
quantity = "run.regime"
[[measure]]
quantity = "run.load_speed"
"""

DESIGN = """
scene = "machine.toml"
[free]
"machine.stiffness" = ["10 N/mm", 2e5]
"machine.damping[0]" = [20.0, 80.0]
"machine.link_stiffness" = [5e4, 5e5]
[ties]
"machine.damping[1]" = ["machine.damping[0]", 0.5]
[choices]
"loads.drag" = [0.5, "1.0 N s/m", 2.0]
[[hold]]
quantity = "jam_frequency"
mode = 3
value = 59.0
[[hold]]
quantity = "support_frequency_squared"
[[demand]]
quantity = "amplitude"
mode = 3
of = [1, 2]
at_least = 2e-3
at_most = "9 mm"
tier = "exact"
[[demand]]
quantity = "spring_cost"
prices = [["10 N/mm", 20.0], ["100 N/mm", 55.0]]
unit = "EUR"
at_most = 300.0
[objective]
quantity = "force_per_amplitude"
mode = 3
of = [1, 2]
tolerances = { "machine.stiffness" = 0.05, "machine.damping" = 0.3 }
statistic = "worst"
samples = 16
[search]
starts = 64
seed = 2
iterations = 20
rate = 0.04
polishing = 3
"""

RECORD = "# camera\ntime (s), angle (deg)\n" + "".join(f"{k / 20:.3f}, {9.0 - k % 7:.4f}\n" for k in range(40))
