"""Solves whitened linear factors in GTSAM and prints the covariance of some variables.

Standard input, one record a line:
  factor ROWS KEYS..., then for each key its matrix row by row, then the right side
  wanted KEY
Standard output: for each wanted key its solution, and its sigmas, on two lines.
"""

import sys

import gtsam
import numpy as np


def main():
    graph, wanted, sizes = gtsam.GaussianFactorGraph(), [], {}
    for line in sys.stdin:
        kind, *rest = line.split()
        if kind == "wanted":
            wanted.append(int(rest[0]))
            continue
        rows, count = int(rest[0]), int(rest[1])
        keys, rest = [], rest[2:]
        for _ in range(count):
            key, width = int(rest[0]), int(rest[1])
            keys.append((key, width))
            sizes[key] = width
            rest = rest[2:]
        numbers = np.array([float(x) for x in rest])
        terms, at = [], 0
        for key, width in keys:
            terms += [key, numbers[at : at + rows * width].reshape(rows, width)]
            at += rows * width
        graph.add(gtsam.JacobianFactor(*terms, numbers[at:], gtsam.noiseModel.Unit.Create(rows)))
    # By orthogonal transformations, along time: rows differ by a factor of a million, and in the default order variables are
    # eliminated that few of them tie down.
    order = gtsam.Ordering()
    for key in sorted(sizes):
        order.push_back(key)
    tree = graph.eliminateMultifrontal(order, function=gtsam.EliminateQR)
    solution = tree.optimize()
    for key in wanted:
        print(*(f"{x:.17g}" for x in solution.at(key)))
        print(*(f"{x:.17g}" for x in np.sqrt(np.diag(tree.marginalCovariance(key)))))


if __name__ == "__main__":
    main()
