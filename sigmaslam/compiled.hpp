// What all compiled modules begin with.
#pragma once
#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include <algorithm>
#include <array>
#include <climits>
#include <cmath>
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <numeric>
#include <stdexcept>
#include <vector>

#if defined(__SSE2__)
#include <immintrin.h>
#endif

namespace py = pybind11;
template <typename Number> using Array = py::array_t<Number, py::array::c_style | py::array::forcecast>;

#define INLINE inline __attribute__((always_inline))

#if defined(__x86_64__)
#include <cpuid.h>

// zig's __builtin_cpu_supports knows no processor.
inline bool has_avx2() {
    unsigned a, b, c, d, saved, high;
    if (!__get_cpuid(1, &a, &b, &c, &d) || !(c & bit_OSXSAVE)) return false;
    __asm__("xgetbv" : "=a"(saved), "=d"(high) : "c"(0));
    // The system saves the wide registers.
    return (saved & 6) == 6 && __get_cpuid_count(7, 0, &a, &b, &c, &d) && (b & bit_AVX2);
}
const bool HAS_AVX2 = has_avx2();
#else
constexpr bool HAS_AVX2 = false;
#endif
