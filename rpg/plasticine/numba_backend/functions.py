"""Logarithm, exponential and what divided differences need, of sixteen numbers at once."""

from __future__ import annotations

from rpg.plasticine.numba_backend.compiling import Vec, inlined
from rpg.plasticine.numba_backend.simd import absolute, exponent, floor, is_double, power_of_two, select

_LOG_2 = 0.6931471805599453
# ln 2 in two parts of which the first times a small whole number is exact, also in float32.
_LOG_2_HIGH, _LOG_2_LOW = 0.693359375, -2.1219444005469057e-04
_ROOT_2 = 1.4142135623730951


@inlined
def log(x: Vec) -> Vec:
    """Natural logarithm of positive normal numbers."""
    e = exponent(x)
    m = x * power_of_two(-e)
    large = m > _ROOT_2
    e = e + select(large, e * 0.0 + 1.0, 0.0)
    m = select(large, 0.5 * m, m)
    # log m = 2 artanh((m - 1) / (m + 1)), whose argument is below 0.172
    s = (m - 1.0) / (m + 1.0)
    z = s * s
    if is_double(x):
        tail = (((z / 21.0 + 1.0 / 19.0) * z + 1.0 / 17.0) * z + 1.0 / 15.0) * z + 1.0 / 13.0
        tail = (tail * z + 1.0 / 11.0) * z + 1.0 / 9.0
    else:
        tail = z * 0.0 + 1.0 / 9.0
    series = ((tail * z + 1.0 / 7.0) * z + 1.0 / 5.0) * z + 1.0 / 3.0
    return e * _LOG_2_HIGH + (e * _LOG_2_LOW + (2.0 * s + 2.0 * s * z * series))


@inlined
def exp(x: Vec) -> Vec:
    """Exponential; arguments are cut to -80 .. 80, so that the result is a normal number in float32."""
    x = select(x < -80.0, -80.0, select(x > 80.0, 80.0, x))
    n = floor(x * (1.0 / _LOG_2) + 0.5)
    # A NaN must not become an index of a power of two; it returns through r.
    whole = select(absolute(n) < 200.0, n, 0.0)
    r = (x - n * _LOG_2_HIGH) - n * _LOG_2_LOW
    if is_double(x):
        tail = (((r / 13.0 + 1.0) * r / 12.0 + 1.0) * r / 11.0 + 1.0) * r / 10.0 + 1.0
        tail = ((tail * r / 9.0 + 1.0) * r / 8.0 + 1.0) * r / 7.0 + 1.0
    else:
        tail = r / 7.0 + 1.0
    series = (((tail * r / 6.0 + 1.0) * r / 5.0 + 1.0) * r / 4.0 + 1.0) * r / 3.0 + 1.0
    return ((series * r / 2.0 + 1.0) * r + 1.0) * power_of_two(whole)


@inlined
def _sinh_over(x: Vec) -> Vec:
    """sinh(x) / x for x below one half in size."""
    z = x * x
    if is_double(x):
        tail = ((z / 210.0 + 1.0) * z / 156.0 + 1.0) * z / 110.0 + 1.0
        tail = tail * z / 72.0 + 1.0
    else:
        tail = z / 72.0 + 1.0
    return (tail * z / 42.0 + 1.0) * z / 20.0 * z / 6.0 + z / 6.0 + 1.0


@inlined
def sinh_ratio(k: Vec, x: Vec) -> Vec:
    """sinh(k x) / sinh(x) for x below one half in size and k in 0 .. 1; k at x = 0."""
    return k * _sinh_over(k * x) / _sinh_over(x)
