"""Results and cost of the optimizer on machines whose optimum is known or published.

    python benchmarks/design.py [--only PART ...]

Parts:

- `speed`: time of 1000 starts with 500 steps each
- `rule`: the antiphase rule from 1000 random starts, and n2/n1 for decreasing damping
- `published`: force per amplitude of the published machine and of the best machine, by leading order and exactly
- `three`: the anti-resonance rule of three masses
- `exact`: a design by exact orbits with 6 free parameters
- `robust`: a design over 256 samples, evaluated for 10,000 other machines
- `free`: time of a value with its gradient relative to the value alone, and searches without gradients for the same problem,
  for 3 to 100 free parameters

Second calls are timed, for which the programs are already compiled.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import jax
import numpy as np
from parts.common import machine_line
from parts.design_free import SIZES, gradient_cost, race

import jaxvib as jv
from optimize import (
    DesignSpace,
    Quantity,
    expected,
    force_per_amplitude,
    hold,
    jam_frequency,
    quantile,
    support_frequency_squared,
    synthesize,
)
from optimize.recipes import anti_resonance

jax.config.update("jax_enable_x64", True)
jv.prepare_cpu()

FORCE = force_per_amplitude(mode=3)
FREE = {"machine.stiffness": (0.01, 0.3), "machine.link_stiffness": (0.1, 1.0)}


def form(damping: float, speed: float = 3.0, natural: tuple[float, float] = (1 / 3, 1 / 3)) -> jv.Dimensionless:
    return jv.Dimensionless(
        "antiphase", natural=natural, damping=(damping, damping), link_natural=2 / 3, link_damping=damping, rho=1.0, eps=1e-3,
        beta=1.0, speed=speed,
    )  # fmt: skip


def space_of(damping: float, speed: float = 3.0, free: dict | None = None) -> DesignSpace:
    held = [hold(jam_frequency(mode=3), 1.0), hold(support_frequency_squared(), 2 / 9)]
    return DesignSpace(form(damping, speed).scene(), FREE if free is None else free, held)


def twice(ask: Callable[[], object]) -> tuple[object, float, float]:
    """Return the result, and the times of the first and of the second call, s."""
    begun = time.perf_counter()
    ask()
    middle = time.perf_counter()
    found = ask()
    return found, middle - begun, time.perf_counter() - middle


def ratio(found: object) -> float:
    k = found.scene.machine.stiffness
    return float(np.sqrt(k[1] / k[0]))


def speed() -> None:
    space = space_of(1e-4)
    _, first, again = twice(lambda: synthesize(space, FORCE, starts=1000, iterations=500, polishing=0, verify=False))
    middle = time.process_time()
    synthesize(space, FORCE, starts=1000, iterations=500, polishing=0, verify=False)
    busy = time.process_time() - middle
    print(f"1000 starts x 500 steps, leading order: first {first:.1f} s, again {again:.2f} s ({busy:.1f} s of CPU time)")


def rule() -> None:
    best = synthesize(space_of(1e-4), FORCE, starts=1000, verify=False)
    print(f"damping 1e-4, rotor speed 3: {best.same} of {best.starts} starts at the best machine, n2/n1 = {ratio(best):.5f}")
    for damping in (1e-2, 1e-3, 1e-4, 1e-5):
        best = synthesize(space_of(damping), FORCE, starts=32, verify=False)
        print(f"  damping {damping:7.0e}: n2/n1 {ratio(best):.5f}, force per amplitude {best.values.min():.4e}")


def published() -> None:
    exact = force_per_amplitude(mode=3, tier="exact")
    print("rotor speed: F/d of the published machine, of the best; gain; n2/n1; |F/d| of the exact motions")
    for n in (1.5, 2.0, 3.0, 5.0):
        theirs = _published(n)
        best = synthesize(space_of(1e-2, n), FORCE, starts=64, verify=False)
        both = [_pressed(s) for s in (theirs, best.scene)]
        exactly = " -> ".join(f"{float(exact(s)):.4e}" for s in (theirs, best.scene))
        gain = f"{abs(both[0]) / abs(both[1]):.4f} x"
        print(f"  {n}: {both[0]:.4e} -> {both[1]:.4e} ({gain}); n2/n1 {ratio(best):.4f}; exact {exactly}")
    more = {
        "mass": ("machine.mass", (0.3, 3.0)),
        "damping": ("machine.damping", (2e-3, 0.1)),
        "speed": ("drive.speed", (1.5, 5.0)),
    }
    for names in (("mass",), ("damping",), ("speed",), tuple(more)):
        freed = {**FREE, **{more[name][0]: more[name][1] for name in names}}
        for wish in (FORCE, exact):
            best = synthesize(space_of(1e-2, 3.0, freed), wish, starts=32, iterations=200, polishing=25, verify=False)
            told = f"leading order {float(FORCE(best.scene)):.4e}, exact {float(exact(best.scene)):.4e}"
            print(f"  {', '.join(names)} free too, {wish.words}: {told}; {best.message}; {best.after.parameters}")


def _pressed(scene: jv.Scene) -> complex:
    """Return F/d, the force of the springs and dampers on the foundation divided by y1 - y2, of complex amplitudes."""
    jam = jv.jam_modes(scene).select(3)
    y, machine = np.asarray(jam.displacement), scene.machine
    supports = np.asarray(machine.stiffness) + 1j * float(jam.omega) * np.asarray(machine.damping)
    return complex(supports @ y / (y[0] - y[1]))


def _published(n: float) -> jv.Scene:
    """Return the machine with n1 = n2, the support budget 2/9 and the jam frequency 1; only the link is then free."""
    space = DesignSpace(
        form(1e-2, n).scene(), {"machine.stiffness[0]": (0.01, 0.3), "machine.link_stiffness": (0.1, 1.0)},
        [hold(jam_frequency(mode=3), 1.0)], ties={"machine.stiffness[1]": "machine.stiffness[0]"},
    )  # fmt: skip
    budget = support_frequency_squared()
    nothing = Quantity("distance from the budget", "", lambda scene: (budget(scene) - 2 / 9) ** 2)
    return synthesize(space, nothing, starts=8, verify=False).scene


def three() -> None:
    for damping in (1.0, 0.1, 0.01):
        machine = jv.three_mass(
            mass=(30.0, 40.0, 30.0), stiffness=(0.0, 4e4, 0.0), damping=(0.0, damping, 0.0), link_stiffness=(2e5, 0.0, 3e5),
            link_damping=(damping, 0.0, damping), exciter=3,
        )  # fmt: skip
        scene = jv.Scene(machine, jv.balls(count=2, mass=0.05, radius=0.1, drag=0.2), jv.ConstantSpeed(160.0))
        modes = jv.jam_modes(scene)
        for mode in (m for m in modes.mode_numbers() if m in (3, 5)):
            before = modes.select(mode)
            design = anti_resonance(scene, mode=mode)
            best = design.run(starts=64, verify=False)
            k, m, omega = best.scene.machine.link_stiffness, (30.0, 30.1), best.after.omega
            share = [float(k[0] / m[0] / omega**2), float(k[2] / m[1] / omega**2)]
            print(
                f"  damping {damping}: mode {mode}, middle per outer amplitude "
                f"{float(before.amplitude[1] / abs(before.displacement[0] - before.displacement[2])):.3e} -> "
                f"{best.values.min():.3e}; k12/M1 = {share[0]:.4f}, k23/M3 = {share[1]:.4f} of Omega^2"
            )


def _practical() -> jv.Scene:
    machine = jv.two_mass(
        mass=(160.0, 92.6), stiffness=(24e3, 46e3), damping=(25.0, 25.0), link_stiffness=2e5, link_damping=30.0
    )
    return jv.Scene(machine, jv.balls(count=3, mass=0.8, radius=0.12, drag=1.5), jv.ConstantSpeed("1500 rpm"))


def exact() -> None:
    free = {"machine.stiffness": (5e3, 1e5), "machine.link_stiffness": (5e4, 5e5), "machine.mass": (80.0, 200.0)}
    space = DesignSpace(
        _practical(), {**free, "loads.drag": (1.0, 2.0)}, [hold(jam_frequency(mode=3)), hold(support_frequency_squared())]
    )
    wish = force_per_amplitude(mode=3, tier="exact")
    best, first, again = twice(lambda: synthesize(space, wish, starts=16, verify=False))
    print(f"exact-orbit design of 6 numbers: first {first:.1f} s, again {again:.2f} s; {best.message}, {best.values.min():.4e}")


def robust() -> None:
    off = {"machine.stiffness": 0.05, "machine.damping": 0.3}
    free = {"machine.stiffness": (5e3, 1e5), "machine.link_stiffness": (5e4, 5e5), "machine.mass": (80.0, 200.0)}
    space = DesignSpace(_practical(), free, [hold(jam_frequency(mode=3)), hold(support_frequency_squared())])
    nominal = synthesize(space, FORCE, starts=32, verify=False)
    wish = expected(FORCE, off, samples=256)
    best, first, again = twice(lambda: synthesize(space, wish, starts=32, verify=False))
    print(f"robust design over 256 samples: first {first:.1f} s, again {again:.2f} s")
    for name, q in (
        ("mean", expected(FORCE, off, samples=10000, seed=7)),
        ("95 %", quantile(FORCE, 0.95, off, samples=10000, seed=7)),
    ):
        print(f"  {name} of 10,000 unseen machines: nominal {float(q(nominal.scene)):.4e}, robust {float(q(best.scene)):.4e}")


def free() -> None:
    """Compare gradients with differential evolution and CMA-ES for a chain of platforms in which all springs are free."""
    for size in SIZES:
        value, both = gradient_cost(size)
        print(f"{size} free numbers: a value {value * 1e6:.0f} us, with its gradient {both / value:.2f} times that")
        race(size, 10.0 if size <= 10 else 60.0)


PARTS = {each.__name__: each for each in (speed, rule, published, three, exact, robust, free)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="*", choices=list(PARTS), default=list(PARTS))
    options = parser.parse_args()
    print(machine_line())
    for name in options.only:
        print(f"--- {name}", flush=True)
        PARTS[name]()


if __name__ == "__main__":
    main()
