"""The commands as a user types them."""

import json
import os
import re
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from scenes import scene

import jaxvib as jv
import jaxvib.cli
from jaxvib.cli.app import _report_error
from jaxvib.cli.output import Output, _wrapped
from jaxvib.machine.files import SCREENS, TEMPLATES
from jaxvib.machine.validation import implausible_numbers


@pytest.mark.parametrize("kind", [*TEMPLATES, *SCREENS])
def test_new_prints_a_scene_file_that_loads(typed, kind):
    code, out, _ = typed("new", kind)
    assert code == 0 and f" {kind.replace('_', '-')}" in typed("new", "--help")[1]
    assert jv.scene_from_toml(out).machine.kind == {
        "torus": "planar_rotor",
        "ball_balancer": "planar_rotor",
        **dict.fromkeys(SCREENS, "plane_body"),
    }.get(kind, kind)
    assert "#" in out and "kg" in out


def test_the_line_of_waiting_counts_seconds_from_its_begin(monkeypatch, capsys):
    clock, rounds = iter([100.0, 101.2, 102.4]), iter([False, False, True])
    monkeypatch.setattr("jaxvib.cli.output.time", SimpleNamespace(monotonic=lambda: next(clock)))
    Output._show_elapsed_time(SimpleNamespace(_done=SimpleNamespace(wait=lambda seconds: next(rounds))))
    assert re.findall(r"computing, (.*?) s ", capsys.readouterr().err) == ["1", "2"]


def test_balance_lists_arrangements_and_their_stability(typed, tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr(jv.BalancedStates, "intervals", lambda _, *a, **options: asked.append((a, options)) or [[50.0, a[1]]])
    machine = jv.planar_rotor(mass=20.0, stiffness="40 N/mm", damping="3 %")
    loads = jv.balls(count=2, mass="50 g", radius=0.08, drag=1.0)
    rotor = jv.Scene(machine, loads, jv.ConstantSpeed("900 rpm"), (jv.Gravity(), jv.StaticImbalance("4 g m")))
    jv.save_scene(rotor, tmp_path / "rotor.toml")
    code, _, err = typed("balance", "rotor.toml")
    assert code == 2 and err.endswith(
        "effects.gravity disturbs the balanced motion; leave it out, or simulate (--without gravity)\n"
    )
    words = ("balance", "rotor.toml", "--without", "gravity")
    ends = ("--between", "300 rpm", "900 rpm", "--points", "16")
    code, out, err = typed(*words, *ends, "--json", "--out", "o")
    document = json.loads(out)
    assert (code, err) == (0, "") and (tmp_path / "o" / "balance.png").stat().st_size > 10_000
    assert document["rotor_speed"] == pytest.approx(30.0 * np.pi) and document["share"] == pytest.approx([0.5])
    for each in document["arrangements"]:
        left = np.sum(0.05 * 0.08 * np.exp(1j * np.array(each["angles"]))) + 0.004
        assert abs(left) < 1e-12 and each["stable"] and each["growth"] < 0.0
        assert each["stable_between"] == [[50.0, pytest.approx(30.0 * np.pi)]]
    range_ = (pytest.approx(10.0 * np.pi), pytest.approx(30.0 * np.pi))
    assert asked == [(range_, {"arrangement": k, "points": 16}) for k in (0, 1)]
    code, out, _ = typed(*words)
    assert code == 0 and out.startswith("balanced motion at 900 rpm: stable\n") and max(map(len, out.splitlines())) <= 80
    assert "imbalance: 50 % of the unbalance of all loads" in out and "to, rpm" not in out
    slow = typed(*words, "--speed", "300 rpm")[1]
    assert slow.startswith("balanced motion at 300 rpm: unstable\n")
    assert "need not reach this motion" in out and "need not reach this motion" not in slow


def test_a_machine_without_springs_raises_a_clear_error(typed, tmp_path):
    loads_ = jv.pendulums(count=2, mass=0.05, radius=0.08, drag=0.04)
    free = {
        "platform": jv.one_mass(mass=50.0, stiffness=0.0, damping=30.0),
        "plane": jv.planar_rotor(mass=37.0, stiffness=0.0, damping=843.0),
        "hinge": jv.rotor(
            mass=37.0,
            transverse_inertia=0.479,
            polar_inertia=0.093,
            stiffness=(6e5, 0.0),
            damping=400.0,
            position=(0.165, -0.155),
        ),
    }
    for name, machine in free.items():
        jv.save_scene(jv.Scene(machine, loads_, jv.ConstantSpeed(100.0)), tmp_path / f"{name}.toml")
    code, out, err = typed("criterion", "platform.toml", "--check", "--out", "o")
    assert (code, out) == (2, "") and "machine.stiffness lets the machine drift" in err and err.count("\n") == 1
    assert typed("criterion", "platform.toml", "--out", "o")[0] == 0
    for name in ("plane", "hinge"):
        for more in ((), ("--out", "o"), ("--loads", "none")):
            code, out, err = typed("whirl", f"{name}.toml", *more)
            assert (code, out) == (2, "") and "machine.stiffness leaves a motion of the rotor without a spring" in err


@pytest.mark.parametrize("given", ["5", '"5 N/m"', "[1.0, 2.0]", '["1 N/m", "soft", 3.0]', "{ a = 1 }", "true"])
def test_terms_without_three_numbers_raise_clear_errors(typed, tmp_path, given):
    text = TEMPLATES["rotor"].replace("# stiffness_terms = [1.159e6, 0.0, 2.98e4]", f"stiffness_terms = {given}")
    assert given in text
    (tmp_path / "rotor.toml").write_text(text)
    code, out, err = typed("whirl", "rotor.toml")
    assert (code, out) == (2, "") and "machine.stiffness_terms" in err and err.count("\n") == 1


def test_whirl_draws_the_campbell_diagram(typed, tmp_path):
    (tmp_path / "rotor.toml").write_text(TEMPLATES["rotor"])
    code, out, _ = typed("whirl", "rotor.toml", "--out", "o", "--json")
    assert code == 0 and len(json.loads(out)["critical"]) == 4
    assert (tmp_path / "o" / "campbell.png").stat().st_size > 10_000


def test_simulate_json_and_files(typed, tmp_path):
    code, out, _ = typed("simulate", "machine.toml", "--until", "4s", "--start", "jam", "--mode", "3", "--json", "--out", "o")
    document = json.loads(out)
    assert code == 0 and document["status"] == "done" and document["time"] == 4.0
    assert abs(document["omega"] - float(jv.jam_modes(scene(speed=150.0)).select(3).omega)) < 0.5
    assert float(jv.Run.load(tmp_path / "o" / "run.npz").omega) == document["omega"]
    assert document["coordinates"] == ["y1", "y2"] and document["units"] == ["m", "m"]
    assert (tmp_path / "o" / "history.png").stat().st_size > 10_000


def test_optimize_json_has_the_promised_keys(typed, tmp_path):
    (tmp_path / "design.toml").write_text(
        """
        scene = "machine.toml"
        [free]
        "machine.stiffness" = [1e4, 1e5]
        [objective]
        quantity = "force_per_amplitude"
        mode = 3
        [search]
        starts = 4
        iterations = 20
        """
    )
    code, out, err = typed("optimize", "design.toml", "--json", "--out", "o")
    document = json.loads(out)
    assert code == 0 and err == ""
    assert {"before", "after", "verified", "starts", "converged"} <= set(document)
    for name in ("before", "after", "verified"):
        keys = {"machine.stiffness", "omega", "amplitude", "foundation_force", "force_per_amplitude"}
        assert set(document[name]) == keys
    assert document["after"]["force_per_amplitude"] < document["before"]["force_per_amplitude"]
    np.testing.assert_allclose(document["verified"]["omega"], document["after"]["omega"], rtol=1e-2)
    found = jv.load_scene(tmp_path / "o" / "found.toml")
    np.testing.assert_allclose(found.machine.stiffness, document["after"]["machine.stiffness"], rtol=1e-7)
    assert "# was" in (tmp_path / "o" / "found.toml").read_text()
    for figure in ("before_after.png", "convergence.png", "history.png"):
        assert (tmp_path / "o" / figure).stat().st_size > 5_000
    assert document["status"] == "done" and document["table"][0]["what"] == "stiffness of support 1"
    code, out, _ = typed("optimize", "design.toml", "--resume", "o/search.npz", "--no-verify")
    assert code == 0 and "from 4 designs" in out and "stiffness of support 2, N/mm" in out and "machine.stiffness" not in out


def test_criterion_json_has_the_promised_keys(typed, tmp_path, monkeypatch):
    """The figure is fine at resonances, beside which the functional spans decades."""
    drawn = []
    monkeypatch.setattr("jaxvib.draw.criterion.criterion_chart", lambda axis, speed, *more: drawn.append(speed))
    code, out, err = typed("criterion", "machine.toml", "--json", "--check", "--out", "o")
    document = json.loads(out)
    assert code == 0 and err == ""
    assert {"resonances", "additional", "balancing", "gathering", "exact_balancing"} <= set(document)
    assert document["balancing"][-1][1] is None
    # The paper's statement for two masses: loads balance between resonance and additional speed, and beyond the last resonance.
    np.testing.assert_allclose(document["balancing"][0], [document["resonances"][0], document["additional"][0]], rtol=2e-3)
    for start, _ in document["exact_balancing"]:
        assert any(a <= start <= (b or np.inf) for a, b in document["balancing"])
    assert (tmp_path / "o" / "criterion.png").exists()
    (speed,) = drawn
    for w in document["resonances"]:
        for share in (-1e-4, 1e-4, -1e-2, 1e-2):
            assert np.min(np.abs(speed - w * (1.0 + share))) < 0.07 * abs(share) * w


def test_criterion_text_has_the_speeds_of_the_damped_machine(typed):
    document = json.loads(typed("criterion", "machine.toml", "--json")[1])
    text = typed("criterion", "machine.toml", "--unit", "rad/s")[1]
    free, damped = (document[name][0] for name in ("resonances", "damped_resonances"))
    printed = re.findall(r"resonance 1[^\d]+([\d.]+)", text)
    assert f"{free:.6g}" != f"{damped:.6g}" and printed == [f"{free:.6g}", f"{damped:.6g}"]


def test_exact_balance_is_searched_from_below_all_resonances(typed, monkeypatch):
    asked = []
    monkeypatch.setattr("jaxvib.steady.balance.states.balanced_intervals", lambda scene, *ends: asked.append(ends) or [])
    document = json.loads(typed("criterion", "machine.toml", "--check", "--json")[1])
    ((begin, end),) = asked
    least = min(document["resonances"])
    assert 0.01 * least < begin < 0.1 * least and max(document["resonances"]) < end == document["exact_up_to"]


WRONG = [
    (("mass = [", "masses = ["), "machine.masses is not a field here; did you mean 'mass'"),
    (("drag = 1.5\n", ""), "loads.drag is missing"),
    (("120.0", "-120.0"), "machine.mass[0] is -120 kg; it must be greater than 0"),
    (("50000.0", '"5 kg"'), "machine.stiffness[0] is '5 kg', which is not in N/m"),
    (("50000.0", "nan"), "machine.stiffness[0] is nan N/m; a finite number is needed"),
    (("count = 3", "count = 0"), "loads.count is 0; it must be a whole number, at least 1"),
    (("speed = 150.0", "speed = -1"), "drive.speed is -1 rad/s; it must be greater than 0"),
    (('kind = "two_mass"', 'kind = "two-mass"'), "machine.kind is 'two-mass'; did you mean 'two_mass'"),
    (("[machine]", "[machin]"), "machin is not part of a scene file; did you mean 'machine'"),
    (("[machine]", "[machine"), "is not a TOML file"),
    (("drag = 1.5", "drag = 1,5"), "; write decimals with a point, not with a comma"),
    (("drag = 1.5", "drag = 1.5 N s/m"), '; write a number with a unit in quotes, such as "400 kg"'),
    (("[machine]", "[a.b]\nc = 1\n[[a.b]]\n[machine]"), "; several tables of one name have two brackets each"),
    (("[machine]", "mass = 5.0\n[machine]"), "mass is not part of a scene file; write it below the header of its table"),
]


@pytest.mark.parametrize(("change", "says"), WRONG)
def test_wrong_scene_files_exit_2_with_a_clear_error(typed, tmp_path, change, says):
    text = (tmp_path / "machine.toml").read_text()
    assert change[0] in text
    (tmp_path / "machine.toml").write_text(text.replace(*change, 1))
    code, out, err = typed("modes", "machine.toml")
    assert code == 2 and out == ""
    assert says in err and err.count("\n") == 1 and "Traceback" not in err


@pytest.mark.parametrize(
    ("words", "code", "says"),
    [
        (("modes", "nothing.toml"), 2, "cannot be read"),
        (("modes", "machine.toml", "--speed", "5 kg"), 2, "is not in rad/s"),
        (("modes", "machine.toml", "--speed", "-1200 rpm"), 2, "--speed is -1200 rpm; it must be greater than 0"),
        (("modes", "machine.toml", "--title", "x"), 2, "--title is used only with --report; add --report FILE.html"),
        (("settle", "machine.toml", "--separation", "3"), 2, "--separation is '3', a number without a unit; write '3 deg' or"),
        (("response", "machine.toml", "--phases", "0, 180"), 2, "--phases is '180', a number without a unit; write '180 deg'"),
        (("modes",), 2, "Missing argument 'SCENE': a scene file, such as `jaxvib new two-mass"),
        (("mode", "machine.toml"), 2, "No such command 'mode'. Did you mean 'modes'?"),
        (("modes", "machine.toml", "--speed", "1200"), 2, "--speed is '1200', a number without a unit; write '1200 rpm' or"),
        (("simulate", "machine.toml", "--until", "1s", "--start", "spinup"), 2, "Did you mean 'spin_up'?"),
        (("simulate", "machine.toml"), 2, "Missing option '--until': End time, such as 20s"),
        (("simulate", "machine.toml", "--until", "5 kg"), 2, "until is '5 kg', which is not in s"),
        (("simulate", "machine.toml", "--until", "-1"), 2, "until is -1 s; it must be greater than 0"),
        (("simulate", "machine.toml", "--until", "1s", "--start", "jam"), 2, "--mode is missing; --start jam needs"),
        (("simulate", "machine.toml", "--until", "1s", "--start", "jam", "--mode", "9"), 2, "numbered 1 to 5"),
        (("simulate", "machine.toml", "--until", "1s", "--start", "jam", "--mode", "1"), 1, "does not exist at rotor speed"),
        (("simulate", "machine.toml", "--until", "9s", "--max-steps", "50"), 1, "max_steps_reached"),
        (("simulate", "machine.toml", "--until", "1s", "--step-tolerance", "1e-30"), 2, "--step-tolerance is 1e-30"),
        (("optimize", "machine.toml"), 2, "this is a scene file, for commands such as modes and regimes; `jaxvib new design`"),
        (("modes", "design.toml"), 2, "this is a design file, for `jaxvib optimize`; give the scene file"),
        (("modes", "recipe.toml"), 2, "scene is not part of a scene file: this is a design file, for `jaxvib optimize`"),
        (("modes", "fit.toml"), 2, "run is not part of a scene file: this is an identification file, for `jaxvib identify`"),
        (("optimize", "fit.toml"), 2, "this is an identification file, for `jaxvib identify`; `jaxvib new design`"),
        (("identify", "machine.toml"), 2, "loads is not part of an identification file: this is a scene file"),
        (("modes", "empty.toml"), 2, "machine is missing; a scene file needs the table [machine] with kind, one of one_mass"),
        (("new", "four-mass"), 2, "four-mass"),
    ],
)
def test_failures_have_an_exit_code_and_a_clear_error(typed, tmp_path, words, code, says):
    files = {
        "design": 'scene = "machine.toml"\n[free]\n',
        "recipe": 'scene = "machine.toml"\n[recipe]\n',
        "fit": '[machine]\nfile = "machine.toml"\n[[run]]\n[[channel]]\n[identify]\n',
        "empty": "",
    }
    for name, text in files.items():
        (tmp_path / f"{name}.toml").write_text(text)
    got, out, err = typed(*words)
    assert (got, out) == (code, "")
    assert says in err and err.count("\n") == 1


def test_refusal_of_an_effect_names_the_option_that_removes_it(typed, tmp_path):
    (tmp_path / "rotor.toml").write_text(TEMPLATES["planar_rotor"])
    for words, option in (
        (["criterion"], "--without gravity"),
        (["envelope", "--until", "2s"], "--without static_imbalance"),
        (["modes", "--exact"], "--without static_imbalance"),
        (
            ["settle", "--drift", "-1"],
            "constant speed of 4392.68 rpm: the final speed of the drive (run_up)\njaxvib: --drift is -1",
        ),
        (["growth", "--until", "2s", "--speed", "0"], "jaxvib: --speed is 0 rad/s; it must be greater than 0"),
    ):
        code, out, err = typed(words[0], "rotor.toml", *words[1:])
        assert (code, out) == (2, "") and option in err


def test_implausible_numbers_of_a_file_are_noted(typed, tmp_path):
    wrong = TEMPLATES["two_mass"].replace('"1500 rpm"', "1500").replace('"120 mm"', "120").replace("5.0e4", "50.0")
    (tmp_path / "wrong.toml").write_text(wrong)
    _, _, err = typed("sketch", "wrong.toml")
    assert err.splitlines() == [
        "note: drive.speed is 14324 rpm; a plain number is in rad/s: did you mean '1500 rpm'?",
        "note: loads.radius is 120 m; a plain number is in m: did you mean '120 mm'?",
        "note: machine.stiffness is so small that the machine sags by 23.3 m; a plain number is in N/m: "
        "did you mean '50 N/mm'?",
    ]
    for kind, text in {**TEMPLATES, **SCREENS}.items():
        (tmp_path / f"{kind}.toml").write_text(text)
        assert typed("describe")[2] == "" and not implausible_numbers(jv.load_scene(tmp_path / f"{kind}.toml"))


def test_failure_with_json_is_one_document(typed):
    code, out, _ = typed("simulate", "machine.toml", "--until", "9s", "--max-steps", "50", "--json")
    error = json.loads(out)["error"]
    assert code == 1 and error["kind"] == "computation" and error["status"] == "max_steps_reached"
    code, out, _ = typed("modes", "machine.toml", "--speed", "0", "--json")
    assert code == 2 and json.loads(out)["error"]["field"] == "--speed" and out.startswith('{\n  "error": {\n    "')


def test_new_never_overwrites(typed):
    assert typed("new", "two-mass", "--out", "here")[0] == 0
    code, _, err = typed("new", "two-mass", "--out", "here")
    assert code == 2 and "not overwritten" in err


def test_installed_command_prints_json_alone(tmp_path):
    jv.save_scene(scene("one_mass", "rollers", speed=60.0), tmp_path / "machine.toml")
    words = [sys.executable, "-c", "from jaxvib_command import main; main()", "modes", str(tmp_path / "machine.toml"), "--json"]
    done = subprocess.run(words, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["rotor_speed"] == 60.0
    assert all(
        line.startswith(("computing, ", "compiling, ")) for line in done.stderr.splitlines()
    )  # lines of progress on a slow computer


def test_import_changes_no_settings_of_jax():
    code = (
        "import sys, jax; before = dict(jax.config.values); import jaxvib, optimize; assert dict(jax.config.values) == before; "
        "assert not any(m.startswith(('jaxvib.cli', 'click', 'pint')) for m in sys.modules)"
    )
    unset = ("XLA_FLAGS", "JAX_COMPILATION_CACHE_DIR", "JAXVIB_AUTOMATIC")
    clean = {name: value for name, value in os.environ.items() if name not in unset}
    subprocess.run([sys.executable, "-c", code], check=True, timeout=120, env=clean)


def test_animate_and_sketch_write_an_animation_and_a_drawing(typed, tmp_path):
    code, out, err = typed("sketch", "machine.toml")
    assert code == 0 and (tmp_path / "sketch.png").stat().st_size > 10_000 and out.endswith("wrote sketch.png\n"), err
    small = ["--seconds", "0.5", "--width", "3", "--end", "0.05s"]
    code, out, err = typed("animate", "machine.toml", "--mode", "3", *small, "--out", "a", "--json")
    assert code == 0 and json.loads(out) == {"frames": 10, "fps": 20.0, "begin": 0.0, "end": pytest.approx(0.045)}, err
    assert (tmp_path / "a" / "animation.gif").exists() and "<script>" in (tmp_path / "a" / "animation.html").read_text()


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["animate", ".", "--out", "a"], "there is no such file"),
        (["animate", "machine.toml", "--out", "a"], "--until is missing; give the duration of the simulation, or --mode"),
        (["animate", "machine.toml", "--mode", "3", "--start", "jam"], "--start needs a simulation: give --until"),
        (["animate", "run.npz", "--mode", "3", "--out", "a"], "--until and --start and --mode apply to a scene file"),
        (["animate", "missing.npz", "--out", "a"], "there is no such file"),
    ],
)
def test_animations_that_cannot_be_made(typed, words, says):
    code, _, err = typed(*words)
    assert code == 2 and says in err


def test_usage_errors_are_sentences_with_clicks_lowest_version(typed, monkeypatch):
    """click below 8.2 has no error for a command without arguments: it prints the help by itself."""
    monkeypatch.delattr("click.exceptions.NoArgsIsHelpError", raising=False)
    monkeypatch.setattr("jaxvib.cli.app._NO_ARGUMENTS", ())
    for words, says in (
        (("modes",), "Missing argument 'SCENE'"),
        (("modes", "m.toml", "--nope"), "No such option"),
        (("no",), "No such command"),
    ):
        code, out, err = typed(*words)
        assert code == 2 and says in err and "Traceback" not in err and out == ""


ENDED = """
import os, signal, sys, threading, time, weakref
import jaxvib_command

class Importing:
    def find_spec(self, name, path, target=None):
        if name == "jaxvib":
            interrupt()

def interrupt():
    os.kill(os.getpid(), signal.SIGINT)
    for _ in range(600):  # not a single sleep: a lost interrupt would end it
        time.sleep(0.1)

def importing():
    sys.meta_path.insert(0, Importing())
    jaxvib_command.main()

def called():
    import jaxvib.cli

    jaxvib.cli.main = MOMENT
    jaxvib_command.main()

def callback():
    machine = {0}
    watch = weakref.ref(machine, lambda _: interrupt())
    del machine

def program():
    import jax

    threading.Timer(0.5, os.kill, [os.getpid(), signal.SIGINT]).start()
    jax.jit(lambda x: jax.lax.while_loop(lambda x: x > 0.0, lambda x: x + 1.0, x))(1.0).block_until_ready()

sys.argv = ["jaxvib", "cost", "machine.toml", *OPTIONS]
importing() if "MOMENT" == "importing" else called()
print("goes on")
"""


@pytest.mark.parametrize("moment", ["importing", "callback", "program"])
@pytest.mark.parametrize("options", [[], ["--json"]])
def test_an_interrupt_ends_a_command_at_once(moment, options):
    """During imports, in a callback, where Python discards exceptions, and within an endless compiled program."""
    script = ENDED.replace("MOMENT", moment).replace("OPTIONS", str(options))
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=600.0)
    assert (done.returncode, done.stderr) == (1, "\njaxvib: interrupted\n")
    error = {"kind": "computation", "status": "interrupted", "message": "interrupted"}
    assert json.loads(done.stdout) == {"error": error} if options else done.stdout == ""


def test_command_imports_nothing_before_it_handles_interrupts():
    """An interrupt during an import of the module itself would print a traceback."""
    script = "import sys; before = {*sys.modules}; import jaxvib_command; print(*({*sys.modules} - before))"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True, timeout=600.0)
    assert done.stdout.split() == ["jaxvib_command"]


INTERRUPTED = """
import signal, sys, threading, time, jaxvib.cli.app
from jaxvib_command import main

def interrupted(arguments):
    thread = threading.Thread(target=compiling)
    thread.start()
    print("answered")
    thread.join()

def compiling():
    for _ in range(3):
        time.sleep(0.2)
        signal.pthread_kill(threading.main_thread().ident, signal.SIGINT)
    time.sleep(3600.0)  # the compiler of a thread goes on

jaxvib.cli.app.run = interrupted
sys.argv = ["jaxvib", "optimize", "-h"]
main()
"""


def test_interrupts_end_a_search_whose_threads_compile():
    """An interrupted `join` marks its thread as finished, so that an orderly exit would crash in the compiler."""
    done = subprocess.run([sys.executable, "-c", INTERRUPTED], capture_output=True, text=True, timeout=600.0)
    assert (done.returncode, done.stdout.strip(), done.stderr) == (1, "answered", "\njaxvib: interrupted\n")


@pytest.mark.parametrize("chosen", [None, "0"])
def test_the_command_hides_messages_for_developers_of_xla(monkeypatch, chosen):
    monkeypatch.delenv("TF_CPP_MIN_LOG_LEVEL", raising=False)
    if chosen is not None:
        monkeypatch.setenv("TF_CPP_MIN_LOG_LEVEL", chosen)
    script = "import os, jaxvib.cli, jaxvib_command as c; jaxvib.cli.main = lambda: print(os.environ['TF_CPP_MIN_LOG_LEVEL'])"
    done = subprocess.run([sys.executable, "-c", f"{script}; c.main()"], capture_output=True, text=True, timeout=600.0)
    assert done.stdout.strip() == (chosen or "3")


LOST = """
import signal, sys, time, weakref, jaxvib.cli.app
from importlib.machinery import ExtensionFileLoader
from jaxvib_command import main

def callback():
    machine = {0}
    watch = weakref.ref(machine, lambda _: signal.raise_signal(signal.SIGINT))
    del machine

def loading():
    self = ExtensionFileLoader("extension", "extension.so")
    signal.raise_signal(signal.SIGINT)

def lost(arguments):
    MOMENT()
    print("goes on")
    time.sleep(3600.0)

jaxvib.cli.app.run = lost
sys.argv = ["jaxvib", "optimize", "-h"]
main()
"""


@pytest.mark.parametrize("moment", ["callback", "loading"])
def test_an_interrupt_of_a_search_is_repeated_if_lost(moment):
    """Callbacks of weak references, as in JAX's caches, discard exceptions; XLA crashes if its import raises one."""
    script = LOST.replace("MOMENT", moment)
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=600.0)
    assert (done.returncode, done.stdout.strip(), done.stderr) == (1, "goes on", "\njaxvib: interrupted\n")


@pytest.mark.parametrize(("words", "raises"), [([], False), (["simulate", "optimize"], False), (["sweep", "-h"], True)])
def test_interrupts_are_exceptions_in_three_commands_only(words, raises, monkeypatch):
    seen, nothing = [], lambda *_: None
    monkeypatch.setattr(sys, "argv", ["jaxvib", *words])
    monkeypatch.setattr("jaxvib.cli._raise_interrupts", seen.append)
    monkeypatch.setattr("jaxvib.cli.prepare", nothing)
    monkeypatch.setattr("jaxvib.cli.gc", SimpleNamespace(disable=nothing, enable=nothing, freeze=nothing))
    monkeypatch.setattr("jaxvib.cli.signal", SimpleNamespace(signal=nothing, SIGINT=2, SIG_IGN=1))
    monkeypatch.setattr("jaxvib.cli.app.run", lambda given: len(given))
    with pytest.raises(SystemExit) as ended:
        jaxvib.cli.main()
    assert ended.value.code == len(words) and len(seen) == raises


def test_sentences_on_a_terminal_break_between_words(monkeypatch):
    monkeypatch.setenv("COLUMNS", "40")
    text = "  a sentence of this machine (573.172, 573.172 rpm) goes on\n" + "┃ a wide table ┃" * 5
    first, second, wide = _wrapped(text).splitlines()
    assert (
        first == "  a sentence of this machine (573.172,"
        and second == "      573.172 rpm) goes on"
        and wide == "┃ a wide table ┃" * 5
    )


def test_lines_of_a_design_file_in_an_error_are_kept(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "40")
    line = '"machine.supports[0].stiffness[1]" = ["63 N/mm", "252 N/mm"]'
    _report_error(False, 1, {"message": f"contradictory: free other parameters:\n[free]\n{line}"})
    assert capsys.readouterr().err.splitlines()[-2:] == ["[free]", line] == _wrapped(f"[free]\n{line}").splitlines()


@pytest.mark.parametrize("command", [("simulate", "--until", "1s"), ("settle",)])
def test_points_of_a_deck_are_checked_before_the_run(typed, monkeypatch, command):
    for name in ("simulate", "settle"):
        monkeypatch.setattr(f"jaxvib.{name}", lambda *_, **__: pytest.fail("a run was begun"))
    name, *rest = command
    code, _, err = typed(name, "machine.toml", *rest, "--deck", "1,2")
    assert code == 2 and "--deck is for bodies in a plane, not for a machine of kind 'two_mass'" in err
    code, _, err = typed(name, "machine.toml", *rest, "--deck", "1.5")
    assert code == 2 and "--deck" in err
