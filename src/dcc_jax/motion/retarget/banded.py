"""Sparse linear least squares whose equations join only unknowns near each other."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import scipy.sparse as sparse
from scipy.linalg import solveh_banded


@dataclass
class Equations:
    """Weighted linear equations, gathered as triplets.

    No equation may reach over more than `width` unknowns.
    """

    width: int
    rows: list[np.ndarray] = field(default_factory=list)
    columns: list[np.ndarray] = field(default_factory=list)
    values: list[np.ndarray] = field(default_factory=list)
    wanted: list[np.ndarray] = field(default_factory=list)
    count: int = 0

    def add(self, columns: np.ndarray, values: np.ndarray, wanted: np.ndarray) -> None:
        """N equations: values [N, K] at unknowns columns [N, K] sum to wanted [N]."""
        count, width = columns.shape
        rows = np.repeat(np.arange(self.count, self.count + count), width)
        self.rows.append(rows)
        self.columns.append(columns.ravel())
        self.values.append(values.ravel())
        self.wanted.append(wanted)
        self.count += count

    def solve(self, size: int) -> np.ndarray:
        """The least-squares solution [size]."""
        rows, columns, values, wanted = (
            np.concatenate(part)
            for part in (self.rows, self.columns, self.values, self.wanted)
        )
        matrix = sparse.csr_array((values, (rows, columns)), shape=(self.count, size))
        normal = sparse.coo_array(matrix.T @ matrix)
        band = np.zeros((min(self.width, size - 1) + 1, size))
        row, column = normal.coords
        upper = row >= column
        band[(row - column)[upper], column[upper]] = normal.data[upper]
        return solveh_banded(band, matrix.T @ wanted, lower=True)
