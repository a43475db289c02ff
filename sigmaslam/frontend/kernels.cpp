// Patches of grey images, aligned and compared: the compiled twin of patch_kernels.py, which says what is computed.
//
// Every sum has a fixed order that does not depend on the instruction set: eight partial sums, added pairwise.
// The compiler may not contract or reorder (-ffp-contract=off, no -ffast-math), so the bits are the same on every run.
#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>

#include <algorithm>
#include <climits>
#include <cmath>
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <stdexcept>
#include <vector>

#if defined(__SSE2__)
#include <emmintrin.h>
#endif

namespace py = pybind11;
using Grey = py::array_t<uint8_t, py::array::c_style | py::array::forcecast>;
using Reals = py::array_t<double, py::array::c_style | py::array::forcecast>;
using Steps = py::array_t<int32_t, py::array::c_style | py::array::forcecast>;

#define INLINE inline __attribute__((always_inline))

namespace {

constexpr int ROW = 16;          // a patch has rows of sixteen numbers; weights are zero beyond its side
constexpr int MOST_SIDE = 15;
constexpr int SIZE = MOST_SIDE * ROW;
constexpr int FRACTIONS = 256;   // of a pixel, that kernels are tabulated for
constexpr int MOST_OCTAVES = 6;  // half octaves of smoothing, 0 to 5
constexpr int MOST_TAPS = 32;
constexpr int MOST_EXTENT = 128;  // pixels that a patch reaches over
constexpr float FLAT = 1e-2f, RIDGE = 1e-6f, NEAREST = 0.2f;

struct Image {
    const uint8_t* pixels;
    int height, width;
};

INLINE int clamp(int value, int most) { return value < 0 ? 0 : value > most ? most : value; }

// Pixels of a row from a column on; those beyond the image repeat its border.
INLINE const uint8_t* pixels_of(const Image& image, int row, int left, int count, uint8_t* buffer) {
    const uint8_t* pixels = image.pixels + static_cast<size_t>(clamp(row, image.height - 1)) * image.width;
    if (left >= 0 && left + count <= image.width) return pixels + left;
    for (int c = 0; c < count; ++c) buffer[c] = pixels[clamp(left + c, image.width - 1)];
    return buffer;
}

// Gaussian weights of the pixels around a place, by its fraction of a pixel; linear in between, padded with zeros.
struct Kernel {
    int reach, taps, padded;
    std::vector<float> weights;

    explicit Kernel(int half_octave) {
        const double sigma = 0.7 * std::exp2(0.5 * half_octave);
        reach = static_cast<int>(std::ceil(4.0 * sigma));
        taps = 2 * reach;
        padded = (taps + 7) / 8 * 8;
        weights.resize((FRACTIONS + 1) * padded);
        for (int k = 0; k <= FRACTIONS; ++k) {
            double sum = 0.0, w[MOST_TAPS];
            for (int t = 0; t < taps; ++t) {
                const double d = (t - reach + 1 - static_cast<double>(k) / FRACTIONS) / sigma;
                sum += w[t] = std::exp(-0.5 * d * d);
            }
            for (int t = 0; t < taps; ++t) weights[k * padded + t] = static_cast<float>(w[t] / sum);
        }
    }
};

const Kernel& kernel(int half_octave) {
    static const std::vector<Kernel> all = [] {
        std::vector<Kernel> made;
        for (int k = 0; k < MOST_OCTAVES; ++k) made.emplace_back(k);
        return made;
    }();
    return all[half_octave];
}

constexpr double LEVEL[2] = {0.0, 0.0};

// Gaussian window of sum 1, standard deviation in samples.
void window(double sigma, int side, float* out) {
    double sum = 0.0, w[SIZE] = {0};
    const int half = side / 2;
    for (int i = 0; i < side; ++i)
        for (int j = 0; j < side; ++j) {
            const double square = (i - half) * (i - half) + (j - half) * (j - half);
            sum += w[i * ROW + j] = std::exp(-0.5 * square / (sigma * sigma));
        }
    for (int k = 0; k < side * ROW; ++k) out[k] = static_cast<float>(w[k] / sum);
}

struct Alignment {
    double shift_u, shift_v;
    float correlation;
};

#define FUNCTIONS "frontend/kernels.inc"
#include "../both_ways.inc"

const auto align_one = HAS_AVX2 ? wide::align_one : plain::align_one;
const auto examine_one = HAS_AVX2 ? wide::examine_one : plain::examine_one;

constexpr int NOWHERE = -1000;  // nothing is found
constexpr int ABOVE = 5, TALL = 11, BEFORE = 8, BROAD = 16;  // of the patches that are searched for along rows

// Sum of absolute differences of two patches, exact in whole numbers on any processor.
INLINE int sum_differences(const uint8_t* a, const uint8_t* b, int width) {
#if defined(__SSE2__)
    __m128i sums = _mm_setzero_si128();
    for (int r = 0; r < TALL; ++r) {
        const __m128i row_a = _mm_loadu_si128(reinterpret_cast<const __m128i*>(a + r * width));
        const __m128i row_b = _mm_loadu_si128(reinterpret_cast<const __m128i*>(b + r * width));
        sums = _mm_add_epi64(sums, _mm_sad_epu8(row_a, row_b));
    }
    return _mm_cvtsi128_si32(sums) + _mm_extract_epi16(sums, 4);
#else
    int sum = 0;
    for (int r = 0; r < TALL; ++r)
        for (int c = 0; c < BROAD; ++c) sum += std::abs(a[r * width + c] - b[r * width + c]);
    return sum;
#endif
}

int search_row(const Image& left, const Image& right, int u, int v, int lowest, int highest, float ratio) {
    const int width = left.width;
    if (u < BEFORE || u + BROAD - BEFORE > width || v < ABOVE || v + TALL - ABOVE > left.height) return NOWHERE;
    const uint8_t* wanted = left.pixels + static_cast<size_t>(v - ABOVE) * width + u - BEFORE;
    const uint8_t* row = right.pixels + static_cast<size_t>(v - ABOVE) * width - BEFORE;
    const int first = std::max(lowest, u + BROAD - BEFORE - width), last = std::min(highest, u - BEFORE);
    int best = INT_MAX, disparity = NOWHERE, second = INT_MAX;
    std::vector<int> costs(std::max(last - first + 1, 0));
    for (int d = first; d <= last; ++d) {
        const int cost = costs[d - first] = sum_differences(wanted, row + u - d, width);
        if (cost < best) best = cost, disparity = d;
    }
    for (int d = first; d <= last; ++d)
        if (std::abs(d - disparity) > 2) second = std::min(second, costs[d - first]);
    if (disparity == NOWHERE || second == INT_MAX || static_cast<float>(best) > ratio * static_cast<float>(second)) return NOWHERE;
    // And back.
    const uint8_t* found = row + u - disparity;
    const uint8_t* line = left.pixels + static_cast<size_t>(v - ABOVE) * width - BEFORE;
    int back = NOWHERE;
    best = INT_MAX;
    for (int d = lowest; d <= highest; ++d) {
        const int there = u - disparity + d;
        if (there < BEFORE || there + BROAD - BEFORE > width) continue;
        const int cost = sum_differences(found, line + there, width);
        if (cost < best) best = cost, back = d;
    }
    return std::abs(back - disparity) <= 1 ? disparity : NOWHERE;
}

Image view(const Grey& image) {
    if (image.ndim() != 2) throw std::invalid_argument("an image must be (H, W)");
    return {image.data(), static_cast<int>(image.shape(0)), static_cast<int>(image.shape(1))};
}

void check(py::ssize_t count, std::initializer_list<py::ssize_t> sizes, int side) {
    for (const auto size : sizes)
        if (size != count) throw std::invalid_argument("all arrays must have a row for each match");
    if (side < 3 || side > MOST_SIDE || side % 2 == 0) throw std::invalid_argument("a patch has 3 to 15 samples a side");
}

// (M, 3): shift of image 1's place, and correlation there.
py::array_t<double> align(const Grey& grey0, const Grey& grey1, const Reals& points0, const Reals& points1,
                          const Reals& back, const Reals& tilt, const Steps& half_octaves, int side, int iterations,
                          double taper) {
    const Image image0 = view(grey0), image1 = view(grey1);
    const py::ssize_t count = half_octaves.size();
    check(count, {points0.size() / 2, points1.size() / 2, back.size() / 4, tilt.size() / 2}, side);
    py::array_t<double> result({count, py::ssize_t{3}});
    double* out = result.mutable_data();
    const double *p0 = points0.data(), *p1 = points1.data(), *b = back.data(), *t = tilt.data();
    const int32_t* steps = half_octaves.data();
    py::gil_scoped_release release;
    alignas(64) float weights[MOST_SIDE * ROW] = {0};
    window(taper, side, weights);
    for (py::ssize_t k = 0; k < count; ++k) {
        const Alignment found = align_one(image0, image1, p0 + 2 * k, p1 + 2 * k, b + 4 * k, t + 2 * k,
                                          std::clamp(steps[k], -5, 5), side, iterations, weights);
        out[3 * k] = found.shift_u, out[3 * k + 1] = found.shift_v, out[3 * k + 2] = found.correlation;
    }
    return result;
}

// (M, 6): correlation, variance of either patch, and uu, uv, vv of the mean patch's gradients.
py::array_t<double> examine(const Grey& grey0, const Grey& grey1, const Reals& points0, const Reals& points1,
                            const Reals& back, const Steps& half_octaves, int side, double taper, float flat) {
    const Image image0 = view(grey0), image1 = view(grey1);
    const py::ssize_t count = half_octaves.size();
    check(count, {points0.size() / 2, points1.size() / 2, back.size() / 4}, side);
    py::array_t<double> result({count, py::ssize_t{6}});
    double* out = result.mutable_data();
    const double *p0 = points0.data(), *p1 = points1.data(), *b = back.data();
    const int32_t* steps = half_octaves.data();
    py::gil_scoped_release release;
    alignas(64) float weights[MOST_SIDE * ROW] = {0};
    window(taper, side, weights);
    for (py::ssize_t k = 0; k < count; ++k)
        examine_one(image0, image1, p0 + 2 * k, p1 + 2 * k, b + 4 * k, std::clamp(steps[k], -5, 5), side, flat,
                    weights, out + 6 * k);
    return result;
}

// (M,) disparities.
py::array_t<int32_t> search_rows(const Grey& grey_left, const Grey& grey_right, const Steps& places, int lowest,
                                 int highest, float ratio) {
    const Image left = view(grey_left), right = view(grey_right);
    if (left.width != right.width || left.height != right.height)
        throw std::invalid_argument("both images must be of one size");
    const py::ssize_t count = places.size() / 2;
    py::array_t<int32_t> result(count);
    int32_t* out = result.mutable_data();
    const int32_t* at = places.data();
    py::gil_scoped_release release;
    for (py::ssize_t k = 0; k < count; ++k)
        out[k] = search_row(left, right, at[2 * k], at[2 * k + 1], lowest, highest, ratio);
    return result;
}

}  // namespace

PYBIND11_MODULE(_kernels, module) {
    module.doc() = "Compiled patch alignment and evidence; sigmaslam.frontend.patch_kernels is the reference.";
    module.def("align", &align);
    module.def("examine", &examine);
    module.def("search_rows", &search_rows);
}
