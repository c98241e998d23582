"""Audits of four scenes, and the share of gravity in the radial load of pendulums, which is below 0.5 % according to a paper.

    python benchmarks/audit.py [--only rotor] [--out FOLDER]

Prints the results of `jaxvib audit` for each scene, and writes FOLDER/audit.json and a figure for each scene. The run takes
some minutes, mostly for compilation. The published machine, whose parameters are dimensionless, is built with M2S = 100 kg, R =
0.1 m and w = 100 rad/s.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import jaxvib as jv

jv.prepare_cpu()

import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402

jax.config.update("jax_enable_x64", True)

from machines import published_rotor, published_torus  # noqa: E402
from parts.common import machine_line  # noqa: E402

from jaxvib.cli.study.audit import audit_text  # noqa: E402
from jaxvib.study.audit.numbers import gravity_share  # noqa: E402
from jaxvib.study.capture.capture import moving_state  # noqa: E402


def scenes() -> dict[str, tuple[jv.Scene, dict[str, Any]]]:
    """Return the four scenes with the arguments of their audits."""
    sized: dict[str, Any] = {"mass_scale": 100.0, "frequency_scale": 100.0, "radius": 0.1}
    numbers: dict[str, Any] = {
        "natural": (1 / 3, 1 / 3),
        "damping": (0.01, 0.01),
        "link_natural": 2 / 3,
        "link_damping": 0.01,
        "rho": 1.0,
    }
    published = jv.Dimensionless("antiphase", **numbers, eps=1e-3, beta=1.0, speed=3.0, **sized)
    torus = published_torus(2.5)
    slow = jv.Scene(
        jv.one_mass(mass=2000.0, stiffness=5e4, damping=1000.0),
        jv.balls(count=1, mass=40.0, radius=0.5, drag=24.0),
        jv.ConstantSpeed("75 rpm"),
        (jv.Gravity(),),
    )
    return {
        "published two-mass machine": (published.scene(), {"mode": 3}),
        "rotor with four pendulums": (published_rotor(mu=9.2e-4, variant="uncoupled"), {"until": 12.0}),
        "torus balancer": (torus, {"start": moving_state(torus, -0.5), "until": 90.0}),
        "slow vertical machine": (slow, {"mode": 1}),
    }


def bearing() -> list[tuple[float, float, float]]:
    """Return the influence of gravity on the radial loads of the published rotor's pendulums, at several speeds.

    The pendulums turn uniformly on a shaft at rest. Each entry contains the speed, rad/s, the largest change of the radial load
    by gravity during a turn (`normal_force`), %, and g/(l Omega^2), %.
    """
    machine = jv.one_mass(mass=1e9, stiffness=1e15, damping=0.0)
    length = float(published_rotor().loads.radius)
    loads = jv.pendulums(count=1, mass=0.05, radius=length, drag=0.0)
    heavy, light = (jv.Scene(machine, loads, jv.ConstantSpeed(460.0), effects) for effects in ((jv.Gravity(),), ()))

    @jax.jit
    def share(omega: jax.Array) -> jax.Array:
        def load(scene: jv.Scene, phi: jax.Array) -> jax.Array:
            return jv.normal_force(scene, 0.0, jv.State(jnp.zeros(1), jnp.zeros(1), (phi[None],), (omega[None],)))[0]

        angles = jnp.linspace(0.0, 2.0 * jnp.pi, 361)
        return jnp.max(jnp.abs(jax.vmap(lambda phi: load(heavy, phi) / load(light, phi))(angles) - 1.0))

    speeds = (100.0, 157.0, 169.6, 271.1, 460.0)
    return [(w, 100.0 * float(share(jnp.asarray(w))), 100.0 * gravity_share(length, w)) for w in speeds]


def main() -> None:
    """Run all audits."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("out"))
    parser.add_argument("--only", default="", help="scenes whose names contain one of these words, separated by commas")
    parser.add_argument(
        "--repeats", type=int, default=3, help="number of timings of a run; 0 for none, which saves compilation"
    )
    asked = parser.parse_args()
    asked.out.mkdir(parents=True, exist_ok=True)
    print(machine_line())
    document: dict[str, Any] = {}
    for name, (scene, how) in scenes().items():
        if not any(word in name for word in asked.only.split(",")):
            continue
        begun = time.perf_counter()
        found = jv.audit(scene, repeats=asked.repeats, **how)
        print(f"== {name} ({time.perf_counter() - begun:.0f} s)\n{audit_text(found)}", flush=True)
        found.plot().savefig(asked.out / f"audit_{name.replace(' ', '_')}.png")
        document[name] = found.as_dict()
    document["bearing"] = bearing()
    print("gravity in the radial load of the published rotor's pendulums (the paper: at most 0.5 %)")
    for omega, measured, formula in document["bearing"]:
        print(f"  {omega:6.1f} rad/s: {measured:.3f} %, g/(l Omega^2) = {formula:.3f} %")
    (asked.out / "audit.json").write_text(json.dumps(document, indent=2))


if __name__ == "__main__":
    main()
