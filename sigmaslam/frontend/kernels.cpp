// Patches of grey images, aligned and compared: the compiled twin of patch_kernels.py, which says what is computed.
//
// Every sum has a fixed order that does not depend on the instruction set: sixteen partial sums, added pairwise.
// The compiler may not contract or reorder (-ffp-contract=off, no -ffast-math), so the bits are the same on every run.
#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>

#include <algorithm>
#include <climits>
#include <cmath>
#include <cstdint>
#include <cstdlib>
#include <stdexcept>
#include <vector>

#if defined(__SSE2__)
#include <emmintrin.h>
#endif

namespace py = pybind11;
using Grey = py::array_t<uint8_t, py::array::c_style | py::array::forcecast>;
using Reals = py::array_t<double, py::array::c_style | py::array::forcecast>;
using Steps = py::array_t<int32_t, py::array::c_style | py::array::forcecast>;

// One function for AVX2 and one for any processor, chosen when the module is loaded.
#if defined(__x86_64__) && defined(__GNUC__) && !defined(__clang__)
#define CLONES __attribute__((target_clones("avx2", "default")))
#else
#define CLONES
#endif
#if defined(__GNUC__)
#define INLINE inline __attribute__((always_inline))
#else
#define INLINE inline
#endif

namespace {

constexpr int ROW = 16;          // a patch has rows of sixteen numbers, the last ones zero
constexpr int MOST_SIDE = 15;
constexpr int FRACTIONS = 256;   // of a pixel, that kernels are tabulated for
constexpr int MOST_OCTAVES = 6;  // half octaves of smoothing, 0 to 5
constexpr int MOST_TAPS = 32;
constexpr int MOST_EXTENT = 128;  // pixels that a patch reaches over
constexpr float FLAT = 1e-2f, RIDGE = 1e-6f, NEAREST = 0.2f;

constexpr int NOWHERE = -1000;   // a disparity that was not found

struct Image {
    const uint8_t* pixels;
    int height, width;
};

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

// Weights for a place; returns the first pixel.
template <int PADDED>
INLINE int weigh(const Kernel& K, double place, float* out) {
    const double whole = std::floor(place);
    const float steps = static_cast<float>(place - whole) * FRACTIONS;
    const int k = std::min(static_cast<int>(steps), FRACTIONS - 1);
    const float share = steps - static_cast<float>(k);
    const float *lower = &K.weights[k * PADDED], *upper = lower + PADDED;
    for (int t = 0; t < PADDED; ++t) out[t] = lower[t] + share * (upper[t] - lower[t]);
    return static_cast<int>(whole) - K.reach + 1;
}

const Kernel& kernel(int half_octave) {
    static const std::vector<Kernel> all = [] {
        std::vector<Kernel> made;
        for (int k = 0; k < MOST_OCTAVES; ++k) made.emplace_back(k);
        return made;
    }();
    return all[half_octave];
}

INLINE int clamp(int value, int most) { return value < 0 ? 0 : value > most ? most : value; }

INLINE float sum16(const float* part) {
    float eight[8], four[4];
    for (int k = 0; k < 8; ++k) eight[k] = part[k] + part[k + 8];
    for (int k = 0; k < 4; ++k) four[k] = eight[k] + eight[k + 4];
    return (four[0] + four[2]) + (four[1] + four[3]);
}

// Sum of products of two patches of `side` rows.
INLINE float dot(const float* a, const float* b, int side) {
    float part[ROW] = {0};
    for (int i = 0; i < side; ++i)
        for (int c = 0; c < ROW; ++c) part[c] += a[i * ROW + c] * b[i * ROW + c];
    return sum16(part);
}

// Samples a pixel apart around a place, without further smoothing: all have the same weights.
INLINE void sample_pixels(const Image& image, double u, double v, int side, float* out) {
    constexpr int TAPS = 6, PADDED = 8;
    const Kernel& K = kernel(0);
    float weights_u[PADDED], weights_v[PADDED], columns[MOST_SIDE + TAPS][ROW], line[2 * ROW] = {0};
    const int left = weigh<PADDED>(K, u, weights_u) - side / 2, top = weigh<PADDED>(K, v, weights_v) - side / 2;
    const int wide = side + TAPS - 1;
    const bool inside = left >= 0 && left + 2 * ROW <= image.width;
    for (int r = 0; r < wide; ++r) {
        const uint8_t* pixels = image.pixels + static_cast<size_t>(clamp(top + r, image.height - 1)) * image.width;
        if (inside)
            for (int c = 0; c < 2 * ROW; ++c) line[c] = pixels[left + c];
        else
            for (int c = 0; c < wide; ++c) line[c] = pixels[clamp(left + c, image.width - 1)];
        float sums[ROW] = {0};
        for (int t = 0; t < TAPS; ++t)
            for (int c = 0; c < ROW; ++c) sums[c] += weights_u[t] * line[c + t];
        for (int c = 0; c < ROW; ++c) columns[r][c] = sums[c];
    }
    for (int i = 0; i < side; ++i) {
        float sums[ROW] = {0};
        for (int t = 0; t < TAPS; ++t)
            for (int c = 0; c < ROW; ++c) sums[c] += weights_v[t] * columns[i + t][c];
        for (int c = 0; c < ROW; ++c) out[i * ROW + c] = c < side ? sums[c] : 0.f;
    }
}

template <int PADDED>
INLINE float sum_products(const float* a, const float* b) {
    float part[PADDED];
    for (int t = 0; t < PADDED; ++t) part[t] = a[t] * b[t];
    for (int t = 8; t < PADDED; ++t) part[t % 8] += part[t];
    return ((part[0] + part[4]) + (part[2] + part[6])) + ((part[1] + part[5]) + (part[3] + part[7]));
}

// One sample at any place.
template <int PADDED>
INLINE float sample(const Image& image, double u, double v, const Kernel& K) {
    float weights_u[PADDED], weights_v[PADDED], sums[PADDED] = {0};
    const int left = weigh<PADDED>(K, u, weights_u), top = weigh<PADDED>(K, v, weights_v), taps = K.taps;
    const bool inside = left >= 0 && left + PADDED <= image.width;
    for (int r = 0; r < taps; ++r) {
        const uint8_t* pixels = image.pixels + static_cast<size_t>(clamp(top + r, image.height - 1)) * image.width;
        if (inside)
            for (int t = 0; t < PADDED; ++t) sums[t] += weights_v[r] * pixels[left + t];
        else
            for (int t = 0; t < PADDED; ++t) sums[t] += weights_v[r] * pixels[clamp(left + t, image.width - 1)];
    }
    return sum_products<PADDED>(weights_u, sums);
}

// Samples where the map `back`, `tilt` takes a grid of the other image, `spacing` apart.
template <int PADDED>
INLINE void sample_map(const Image& image, double u, double v, double spacing, const double* back, const double* tilt,
                       const Kernel& K, int side, float* out) {
    const int half = side / 2;
    for (int i = 0; i < side; ++i) {
        double places_u[ROW], places_v[ROW];
        for (int c = 0; c < ROW; ++c) {
            const double x = spacing * (c - half), y = spacing * (i - half);
            const double du = back[0] * x + back[1] * y, dv = back[2] * x + back[3] * y;
            const double depth = std::max(1.0 - (du * tilt[0] + dv * tilt[1]), static_cast<double>(NEAREST));
            places_u[c] = u + du / depth, places_v[c] = v + dv / depth;
        }
        for (int c = 0; c < ROW; ++c)
            out[i * ROW + c] = c < side ? sample<PADDED>(image, places_u[c], places_v[c], K) : 0.f;
    }
}

// Samples `spacing` apart around a place: first down the columns of the image, then along the rows.
template <int PADDED>
INLINE void sample_grid(const Image& image, double u, double v, double spacing, const Kernel& K, int side, float* out) {
    float weights_u[MOST_SIDE][PADDED], weights_v[MOST_SIDE][PADDED], line[MOST_EXTENT];
    int first_u[MOST_SIDE] = {0}, first_v[MOST_SIDE] = {0};
    for (int k = 0; k < side; ++k) {
        first_u[k] = weigh<PADDED>(K, u + spacing * (k - side / 2), weights_u[k]);
        first_v[k] = weigh<PADDED>(K, v + spacing * (k - side / 2), weights_v[k]);
    }
    const int left = first_u[0], wide = (first_u[side - 1] + PADDED - left + 7) / 8 * 8;
    const bool inside = left >= 0 && left + wide <= image.width;
    for (int i = 0; i < side; ++i) {
        for (int x = 0; x < wide; ++x) line[x] = 0.f;
        for (int t = 0; t < K.taps; ++t) {
            const size_t row = clamp(first_v[i] + t, image.height - 1);
            const uint8_t* pixels = image.pixels + row * image.width;
            if (inside)
                for (int x = 0; x < wide; ++x) line[x] += weights_v[i][t] * pixels[left + x];
            else
                for (int x = 0; x < wide; ++x) line[x] += weights_v[i][t] * pixels[clamp(left + x, image.width - 1)];
        }
        for (int c = 0; c < ROW; ++c)
            out[i * ROW + c] = c < side ? sum_products<PADDED>(weights_u[c], line + first_u[c] - left) : 0.f;
    }
}

// Samples of a patch: where its map takes the grid, or the grid itself (back and tilt null).
template <int PADDED>
INLINE void sample_any(const Image& image, double u, double v, double spacing, const double* back, const double* tilt,
                       const Kernel& K, int side, float* out) {
    if (back)
        sample_map<PADDED>(image, u, v, spacing, back, tilt, K, side, out);
    else
        sample_grid<PADDED>(image, u, v, spacing, K, side, out);
}

INLINE void sample_patch(const Image& image, double u, double v, double spacing, const double* back, const double* tilt,
                         int half_octave, int side, float* out) {
    const Kernel& K = kernel(half_octave);
    if (back && back[0] == 1.0 && back[1] == 0.0 && back[2] == 0.0 && back[3] == 1.0 && tilt[0] == 0.0 && tilt[1] == 0.0)
        back = nullptr;
    if (!back && spacing == 1.0 && half_octave == 0)
        sample_pixels(image, u, v, side, out);
    else if (K.padded == 8)
        sample_any<8>(image, u, v, spacing, back, tilt, K, side, out);
    else if (K.padded == 16)
        sample_any<16>(image, u, v, spacing, back, tilt, K, side, out);
    else if (K.padded == 24)
        sample_any<24>(image, u, v, spacing, back, tilt, K, side, out);
    else
        sample_any<32>(image, u, v, spacing, back, tilt, K, side, out);
}

constexpr double LEVEL[2] = {0.0, 0.0};

// Gaussian window of sum 1, standard deviation in samples.
void window(double sigma, int side, float* out) {
    double sum = 0.0, w[MOST_SIDE * ROW] = {0};
    const int half = side / 2;
    for (int i = 0; i < side; ++i)
        for (int j = 0; j < side; ++j) {
            const double square = (i - half) * (i - half) + (j - half) * (j - half);
            sum += w[i * ROW + j] = std::exp(-0.5 * square / (sigma * sigma));
        }
    for (int k = 0; k < side * ROW; ++k) out[k] = static_cast<float>(w[k] / sum);
}

// Takes the weighted mean away; returns the weighted variance. What lies beyond the side stays zero.
INLINE float centre(float* patch, const float* weights, int side) {
    const float mean = dot(patch, weights, side);
    float part[ROW] = {0};
    for (int i = 0; i < side; ++i)
        for (int c = 0; c < ROW; ++c) {
            const int k = i * ROW + c;
            patch[k] = c < side ? patch[k] - mean : 0.f;
            part[c] += weights[k] * patch[k] * patch[k];
        }
    return sum16(part);
}

INLINE void scale(float* patch, float factor, int side) {
    for (int k = 0; k < side * ROW; ++k) patch[k] *= factor;
}

// Central differences, one-sided at the border, over samples `spacing` apart.
INLINE void gradients(const float* patch, float spacing, int side, float* along_u, float* along_v) {
    const float half = 0.5f / spacing, whole = 1.f / spacing;
    for (int i = 0; i < side; ++i) {
        const int above = std::max(i - 1, 0), below = std::min(i + 1, side - 1);
        const float factor = below - above == 2 ? half : whole;
        for (int c = 0; c < ROW; ++c) {
            const int before = std::max(c - 1, 0), after = std::min(c + 1, side - 1), k = i * ROW + c;
            along_u[k] = c < side ? (after - before == 2 ? half : whole) * (patch[i * ROW + after] - patch[i * ROW + before]) : 0.f;
            along_v[k] = c < side ? factor * (patch[below * ROW + c] - patch[above * ROW + c]) : 0.f;
        }
    }
}

INLINE void multiply(const float* a, const float* b, int side, float* out) {
    for (int k = 0; k < side * ROW; ++k) out[k] = a[k] * b[k];
}

struct Alignment {
    double shift_u, shift_v;
    float correlation;
};

CLONES Alignment align_one(const Image& image0, const Image& image1, const double* p0, const double* p1,
                           const double* back, const double* tilt, int half_octaves, int side, int iterations,
                           const float* weights) {
    constexpr int SIZE = MOST_SIDE * ROW;
    alignas(64) float fixed[SIZE], along_u[SIZE], along_v[SIZE], moved[SIZE], product[SIZE];
    const int smooth0 = std::max(-half_octaves, 0), smooth1 = std::max(half_octaves, 0);
    const double spacing = std::exp2(0.5 * smooth1);
    sample_patch(image0, p0[0], p0[1], spacing, back, tilt, smooth0, side, fixed);
    scale(fixed, 1.f / std::sqrt(centre(fixed, weights, side) + FLAT), side);
    gradients(fixed, static_cast<float>(spacing), side, along_u, along_v);
    multiply(along_u, weights, side, product);
    const float uu = dot(product, along_u, side) + RIDGE, uv = dot(product, along_v, side);
    multiply(along_v, weights, side, product);
    const float vv = dot(product, along_v, side) + RIDGE, determinant = uu * vv - uv * uv;
    double shift_u = 0.0, shift_v = 0.0;
    for (int step = 0;; ++step) {
        sample_patch(image1, p1[0] + shift_u, p1[1] + shift_v, spacing, nullptr, nullptr, smooth1, side, moved);
        scale(moved, 1.f / std::sqrt(centre(moved, weights, side) + FLAT), side);
        if (step == iterations) {
            multiply(moved, fixed, side, product);
            return {shift_u, shift_v, dot(product, weights, side)};
        }
        for (int k = 0; k < side * ROW; ++k) product[k] = weights[k] * (moved[k] - fixed[k]);
        const float eu = dot(product, along_u, side), ev = dot(product, along_v, side);
        const double du = static_cast<double>((vv * eu - uv * ev) / determinant);
        const double dv = static_cast<double>((uu * ev - uv * eu) / determinant);
        const double bound = std::min(1.0, spacing / std::max(std::sqrt(du * du + dv * dv), 1e-9));
        shift_u -= bound * du;
        shift_v -= bound * dv;
    }
}

CLONES void examine_one(const Image& image0, const Image& image1, const double* p0, const double* p1,
                        const double* back, int half_octaves, int side, float flat, const float* weights, double* out) {
    constexpr int SIZE = MOST_SIDE * ROW;
    alignas(64) float first[SIZE], second[SIZE], along_u[SIZE], along_v[SIZE], product[SIZE];
    const int smooth0 = std::max(-half_octaves, 0), smooth1 = std::max(half_octaves, 0);
    const double spacing = std::exp2(0.5 * smooth1);
    sample_patch(image0, p0[0], p0[1], spacing, back, LEVEL, smooth0, side, first);
    sample_patch(image1, p1[0], p1[1], spacing, nullptr, nullptr, smooth1, side, second);
    const float variance0 = centre(first, weights, side) + flat, variance1 = centre(second, weights, side) + flat;
    multiply(first, second, side, product);
    out[0] = dot(product, weights, side) / std::sqrt(variance0 * variance1);
    out[1] = variance0;
    out[2] = variance1;
    const float factor0 = 0.5f / std::sqrt(variance0), factor1 = 0.5f / std::sqrt(variance1);
    for (int k = 0; k < side * ROW; ++k) product[k] = factor0 * first[k] + factor1 * second[k];
    gradients(product, 1.f, side, along_u, along_v);
    multiply(along_u, weights, side, product);
    out[3] = dot(product, along_u, side);
    out[4] = dot(product, along_v, side);
    multiply(along_v, weights, side, product);
    out[5] = dot(product, along_v, side);
}

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

CLONES int search_row(const Image& left, const Image& right, int u, int v, int lowest, int highest, float ratio) {
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
