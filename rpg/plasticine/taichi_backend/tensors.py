"""Symmetric 3x3 tensors on the device: six stored numbers, eigenvectors, isotropic functions."""

from rpg.plasticine.taichi_backend.types import Static, Value, func
from rpg.plasticine.taichi_module import ti

_TINY = 1e-30  # keeps the rotation defined where there is nothing to rotate


@func
def unpack(six: Value) -> Value:
    """The symmetric matrix of six numbers xx, xy, xz, yy, yz, zz."""
    return ti.Matrix([[six[0], six[1], six[2]], [six[1], six[3], six[4]], [six[2], six[4], six[5]]])


@func
def pack(matrix: Value) -> Value:
    """The six numbers of a symmetric matrix."""
    return ti.Vector([matrix[0, 0], matrix[0, 1], matrix[0, 2], matrix[1, 1], matrix[1, 2], matrix[2, 2]])


@func
def unpack_adjoint(six: Value) -> Value:
    """The adjoint of a symmetric matrix from that of its six numbers, each of which stands in one or two places."""
    return unpack(ti.Vector([six[0], 0.5 * six[1], 0.5 * six[2], six[3], 0.5 * six[4], six[5]]))


@func
def pack_adjoint(matrix: Value) -> Value:
    """The adjoint of six numbers from that of the symmetric matrix."""
    return ti.Vector(
        [matrix[0, 0], 2.0 * matrix[0, 1], 2.0 * matrix[0, 2], matrix[1, 1], 2.0 * matrix[1, 2], matrix[2, 2]]
    )


@func
def eigen(a: Value, sweeps: Static, real: Static) -> Value:
    """Eigenvalues and eigenvectors (columns) of a symmetric 3x3 matrix by cyclic Jacobi rotations.

    Golub and Van Loan, Matrix Computations, section 8.5. Equal eigenvalues need no care: what is diagonal already is
    not rotated.
    """
    values = ti.Vector([a[0, 0], a[1, 1], a[2, 2]])
    rest = ti.Vector(
        [a[1, 2], a[0, 2], a[0, 1]]
    )  # the entry that has neither the row nor the column of its number
    vectors = ti.Matrix.identity(real, 3)
    for _ in range(sweeps):
        for p, q, r in ti.static(((0, 1, 2), (0, 2, 1), (1, 2, 0))):
            difference = values[q] - values[p]
            length = ti.abs(difference) + ti.sqrt(difference * difference + 4.0 * rest[r] * rest[r])
            tangent = 2.0 * rest[r] / ti.max(length, real(_TINY))
            if difference < 0.0:
                tangent = -tangent
            cosine = 1.0 / ti.sqrt(
                1.0 + tangent * tangent
            )  # a rotation whatever the tangent, underflow included
            sine = tangent * cosine
            values[p] -= tangent * rest[r]
            values[q] += tangent * rest[r]
            rest[r] = 0.0
            entry_p, entry_q = rest[q], rest[p]
            rest[q] = cosine * entry_p - sine * entry_q
            rest[p] = sine * entry_p + cosine * entry_q
            for i in ti.static(range(3)):
                vector_p, vector_q = vectors[i, p], vectors[i, q]
                vectors[i, p] = cosine * vector_p - sine * vector_q
                vectors[i, q] = sine * vector_p + cosine * vector_q
    return values, vectors


@func
def compose(values: Value, vectors: Value) -> Value:
    """The symmetric matrix with these eigenvalues and eigenvectors."""
    scaled = vectors
    for i, j in ti.static(ti.ndrange(3, 3)):
        scaled[i, j] = vectors[i, j] * values[j]
    return scaled @ vectors.transpose()


@func
def sinhc(x: Value) -> Value:
    """``sinh(x) / x``, 1 at 0."""
    square = x * x
    result = 1.0 + square * (1.0 / 6.0 + square * (1.0 / 120.0 + square / 5040.0))
    if ti.abs(x) > 0.1:
        result = (ti.exp(x) - ti.exp(-x)) / (2.0 * x)
    return result
