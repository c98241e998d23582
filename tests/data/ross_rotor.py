"""Flexible rotor of ROSS (ross-rotordynamics 2.3.0): writes its matrices and whirl speeds to ross_rotor.npz beside this file.

    pip install ross-rotordynamics "plotly<6"
    python tests/data/ross_rotor.py

Steel shaft of 1.5 m and 50 mm with 6 Timoshenko elements, two discs of 280 mm, two bearings of unequal stiffness. The
coordinates are x, y and the rotations about x and y of nodes 0 to 6. The others, axial and torsional, are not coupled with
them.
"""

from pathlib import Path

import numpy as np

LATERAL = [6 * node + k for node in range(7) for k in (0, 1, 3, 4)]


def main() -> None:
    import ross as rs  # needed only to write the file anew

    steel = rs.Material(name="steel", rho=7810, E=211e9, G_s=81.2e9)
    shaft = [rs.ShaftElement(L=0.25, idl=0.0, odl=0.05, material=steel) for _ in range(6)]
    discs = [rs.DiskElement.from_geometry(n=n, material=steel, width=0.07, i_d=0.05, o_d=0.28) for n in (2, 4)]
    bearings = [rs.BearingElement(n=n, kxx=1e6, kyy=8e5, cxx=500.0, cyy=500.0) for n in (0, 6)]
    rotor = rs.Rotor(shaft, discs, bearings)
    whole = [np.asarray(matrix, float) for matrix in (rotor.M(0.0), rotor.C(0.0), rotor.K(0.0), rotor.G())]
    other = np.setdiff1d(np.arange(42), LATERAL)
    mass, damping, stiffness, gyroscopic = (matrix[np.ix_(LATERAL, LATERAL)] for matrix in whole)
    assert all(np.all(matrix[np.ix_(LATERAL, other)] == 0.0) for matrix in whole)
    uncoupled = np.linalg.eigvals(np.linalg.solve(whole[0][np.ix_(other, other)], whole[2][np.ix_(other, other)]))
    uncoupled = np.sqrt(np.abs(uncoupled))
    speeds, whirl = np.array([0.0, 500.0, 1000.0, 1500.0]), []
    for speed in speeds:
        found = np.asarray(rotor.run_modal(speed=float(speed), num_modes=80).wd)
        own = [w for w in found if w > 1.0 and np.min(np.abs(uncoupled - w)) > 1e-5 * w]
        whirl.append(np.sort(own)[:10])
    names = {"mass": mass, "damping": damping, "stiffness": stiffness, "gyroscopic": gyroscopic}
    np.savez_compressed(Path(__file__).with_suffix(".npz"), **names, speeds=speeds, whirl=np.array(whirl))


if __name__ == "__main__":
    main()
