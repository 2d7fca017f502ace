"""Sums of 6x6 blocks: the normal equations of factors between poses, on a sparsity pattern that is found only once."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray as Array
from scipy import sparse

from groundtruth.factors import Terms

WITHIN = np.arange(6)


class BlockPattern:
    """Where each factor's blocks J_i' J_j go. Only blocks on and above the diagonal are summed, then mirrored."""

    def __init__(self, poses: int, indices: Sequence[Array]) -> None:
        self._poses = poses
        codes, self._turned = [], []
        for index in indices:
            for i in range(index.shape[1]):
                for j in range(i, index.shape[1]):
                    turned = index[:, i] > index[:, j]
                    low, high = np.minimum(index[:, i], index[:, j]), np.maximum(index[:, i], index[:, j])
                    codes.append(low * poses + high)
                    self._turned.append(turned)
        unique, slots = np.unique(np.concatenate(codes), return_inverse=True)
        self._slots = np.split(slots, np.cumsum([len(c) for c in codes])[:-1])
        self._low, self._high = unique // poses, unique % poses
        self._layout = self._csc_layout()

    def _csc_layout(self) -> tuple[Int[Array, " e"], Int[Array, " e"], Int[Array, " c"]]:
        """(entry of the stacked blocks, row, column pointer) of the symmetric matrix in CSC order."""
        low, high = self._low[:, None, None], self._high[:, None, None]
        rows = np.broadcast_to(6 * low + WITHIN[:, None], (len(self._low), 6, 6))
        columns = np.broadcast_to(6 * high + WITHIN[None, :], (len(self._low), 6, 6))
        entry = np.arange(rows.size).reshape(rows.shape)
        off = self._low != self._high
        rows, columns, entry = (
            np.concatenate([a.ravel(), b[off].ravel()]) for a, b in ((rows, columns), (columns, rows), (entry, entry))
        )
        order = np.lexsort((rows, columns))
        pointer = np.concatenate([[0], np.cumsum(np.bincount(columns, minlength=6 * self._poses))])
        return entry[order], rows[order], pointer

    def sum(self, terms: Sequence[Terms]) -> tuple[sparse.csc_matrix, Float[Array, " d"]]:
        """J' J and -J' r of whitened residuals and Jacobians whose poses are those of the pattern."""
        blocks, right = np.zeros((len(self._low), 6, 6)), np.zeros((self._poses, 6))
        part = 0
        for residual, jacobians, index in terms:
            for i, A in enumerate(jacobians):
                transposed = np.swapaxes(A, -1, -2)
                _add(right, index[:, i], -(transposed @ residual[..., None])[..., 0])
                for B in jacobians[i:]:
                    block = transposed @ B
                    turned = self._turned[part]
                    if turned.any():
                        block[turned] = np.swapaxes(block[turned], -1, -2)
                    if i < len(jacobians) and B is not A:
                        same = self._low[self._slots[part]] == self._high[self._slots[part]]
                        if (
                            same.any()
                        ):  # one pose twice in a factor: both J_i' J_j and J_j' J_i belong to its diagonal block
                            block[same] += np.swapaxes(block[same], -1, -2)
                    _add(blocks, self._slots[part], block)
                    part += 1
        entry, rows, pointer = self._layout
        size = 6 * self._poses
        return sparse.csc_matrix((blocks.ravel()[entry], rows, pointer), shape=(size, size)), right.ravel()


def _add(target: Float[Array, "..."], index: Int[Array, " m"], values: Float[Array, "..."]) -> None:
    """target[index] += values, where an index may occur often: sorted, then summed run by run."""
    if len(index) == 0:
        return
    order = np.argsort(index, kind="stable")
    starts = np.concatenate([[0], np.flatnonzero(np.diff(index[order])) + 1])
    target[index[order][starts]] += np.add.reduceat(values[order], starts, axis=0)
