// The compiled twins of patch_kernels.py, which says what is computed, and of functions that its docstring names.
//
// Every sum has a fixed order that does not depend on the instruction set: eight partial sums, added pairwise.
// The compiler may not contract or reorder (-ffp-contract=off, no -ffast-math), so the bits are the same on every run.
#include "../compiled.hpp"

using Grey = Array<uint8_t>;
using Reals = Array<double>;
using Steps = Array<int32_t>;
using Places = Array<float>;

namespace {

constexpr int ROW = 16;          // a patch has rows of sixteen numbers; weights are zero beyond its side
constexpr int MOST_SIDE = 15;
constexpr int SIZE = MOST_SIDE * ROW;
constexpr int FRACTIONS = 256;   // of a pixel, that kernels are tabulated for
constexpr int MOST_OCTAVES = 6;  // half octaves of smoothing, 0 to 5
constexpr int MOST_TAPS = 32;
constexpr int MOST_EXTENT = 128;  // pixels that a patch reaches over
constexpr double MOST_ZOOM = 25.0, LEAST_CORRELATION = 0.5;  // of areas; of patches that fit
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

// Fetches the pixels around a place while another one is worked on: no processor foresees where patches lie.
INLINE void prefetch(const Image& image, const double* place) {
    constexpr int REACHED = 8;  // pixels
    if (!(place[0] >= 0.0 && place[0] < image.width && place[1] >= 0.0 && place[1] < image.height)) return;
    const int u = static_cast<int>(place[0]), v = static_cast<int>(place[1]);
    for (int row = std::max(v - REACHED, 0); row < std::min(v + REACHED, image.height); ++row) {
        const uint8_t* pixels = image.pixels + static_cast<size_t>(row) * image.width + u;
        __builtin_prefetch(pixels - REACHED), __builtin_prefetch(pixels + REACHED);
    }
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

constexpr double SAME[4] = {1.0, 0.0, 0.0, 1.0}, LEVEL[2] = {0.0, 0.0};  // a map that changes nothing

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

constexpr int REACH = 3, BEYOND = 4;  // of the smoothing before derivatives are summed, and of both, pixels

constexpr int NOWHERE = -1000;  // nothing is found
constexpr int ABOVE = 5, TALL = 11, BEFORE = 8, BROAD = 16;  // of the patches that are searched for along rows

struct Alignment {
    double shift_u, shift_v;
    float correlation;
};

constexpr int CELL = 4, BLOB_REACH = 4, BLOB_BORDER = 8;  // of the detector, as the constants below
constexpr double BLOB_SIGMA = 1.4;
constexpr float LEAST_RESPONSE = 1e-9f;

struct Blob {
    float strength;
    int pixel;
};

#define FUNCTIONS "frontend/kernels.inc"
#include "../both_ways.inc"

const auto align_one = HAS_AVX2 ? wide::align_one : plain::align_one;
const auto examine_one = HAS_AVX2 ? wide::examine_one : plain::examine_one;
const auto search_row = HAS_AVX2 ? wide::search_row : plain::search_row;
const auto patch_energies = HAS_AVX2 ? wide::patch_energies : plain::patch_energies;
const auto sum_derivatives = HAS_AVX2 ? wide::sum_derivatives : plain::sum_derivatives;
const auto blob_response = HAS_AVX2 ? wide::blob_response : plain::blob_response;
const auto cell_means = HAS_AVX2 ? wide::cell_means : plain::cell_means;
const auto find_maxima = HAS_AVX2 ? wide::find_maxima : plain::find_maxima;

Image view(const Grey& image) {
    if (image.ndim() != 2) throw std::invalid_argument("an image must be (H, W)");
    return {image.data(), static_cast<int>(image.shape(0)), static_cast<int>(image.shape(1))};
}

void check(py::ssize_t count, std::initializer_list<py::ssize_t> sizes, int side) {
    for (const auto size : sizes)
        if (size != count) throw std::invalid_argument("all arrays must have a row for each match");
    if (side < 3 || side > MOST_SIDE || side % 2 == 0) throw std::invalid_argument("a patch has 3 to 15 samples a side");
}

// The images that patches come from, and of each patch which one: the first where that is not said.
struct Sources {
    std::vector<Image> images;
    const int32_t* which;

    Sources(const std::vector<Grey>& greys, const Steps& source, py::ssize_t count) {
        for (const Grey& grey : greys) images.push_back(view(grey));
        which = source.size() ? source.data() : nullptr;
        if (which && source.size() != count) throw std::invalid_argument("all arrays must have a row for each match");
        const int most = static_cast<int>(images.size());
        if (!which && !most) throw std::invalid_argument("no image is given");
        for (py::ssize_t k = 0; which && k < count; ++k)
            if (which[k] < 0 || which[k] >= most) throw std::invalid_argument("there is no image of that number");
    }

    const Image& operator[](py::ssize_t k) const { return images[which ? which[k] : 0]; }
};

bool shows(const Image& image, const double* place) {
    return place[0] >= 0.0 && place[0] <= image.width - 1 && place[1] >= 0.0 && place[1] <= image.height - 1;
}

// (M, 2) places in image 1, (M,) whether they moved, and (M,) correlation there: `align_patches`.
py::tuple align(const std::vector<Grey>& greys0, const Steps& source, const Grey& grey1, const Reals& points0,
                const Reals& points1, const Reals& maps, const Reals& tilts, double reach, int side, int iterations,
                double taper) {
    const Image image1 = view(grey1);
    const py::ssize_t count = maps.size() / 4;
    check(count, {points0.size() / 2, points1.size() / 2, tilts.size() / 2}, side);
    const Sources images0(greys0, source, count);
    py::array_t<double> result({count, py::ssize_t{2}}), correlations(count);
    py::array_t<bool> moves(count);
    double *place = result.mutable_data(), *correlation = correlations.mutable_data();
    bool* moved = moves.mutable_data();
    const double *p0 = points0.data(), *p1 = points1.data(), *A = maps.data(), *tilt = tilts.data();
    {
        py::gil_scoped_release release;
        alignas(64) float weights[MOST_SIDE * ROW] = {0};
        window(taper, side, weights);
        for (py::ssize_t k = 0; k < count; ++k, p0 += 2, p1 += 2, A += 4, tilt += 2, place += 2) {
            if (k + 1 < count) prefetch(images0[k + 1], p0 + 2), prefetch(image1, p1 + 2);
            place[0] = p1[0], place[1] = p1[1], moved[k] = false, correlation[k] = 0.0;
            const double zoom = A[0] * A[3] - A[1] * A[2];  // of areas
            if (!(zoom > 1.0 / MOST_ZOOM && zoom < MOST_ZOOM && shows(images0[k], p0) && shows(image1, p1))) continue;
            const double back[4] = {A[3] / zoom, -A[1] / zoom, -A[2] / zoom, A[0] / zoom};
            const double octaves = std::nearbyint(std::log2(zoom));
            const Alignment found = align_one(images0[k], image1, p0, p1, back, tilt,
                                              static_cast<int>(octaves), side, iterations, weights);
            correlation[k] = found.correlation;
            const double length = std::hypot(found.shift_u, found.shift_v);
            moved[k] = correlation[k] > LEAST_CORRELATION && length <= reach * std::max(1.0, std::exp2(0.5 * octaves));
            if (moved[k]) place[0] += found.shift_u, place[1] += found.shift_v;
        }
    }
    return py::make_tuple(result, moves, correlations);
}

// (M, 6): correlation, variance of either patch, and uu, uv, vv of the mean patch's gradients.
py::array_t<double> examine(const std::vector<Grey>& greys0, const Steps& source, const Grey& grey1,
                            const Reals& points0, const Reals& points1, const Reals& back, const Steps& half_octaves,
                            int side, double taper, float flat) {
    const Image image1 = view(grey1);
    const py::ssize_t count = half_octaves.size();
    check(count, {points0.size() / 2, points1.size() / 2, back.size() / 4}, side);
    const Sources images0(greys0, source, count);
    py::array_t<double> result({count, py::ssize_t{6}});
    double* out = result.mutable_data();
    const double *p0 = points0.data(), *p1 = points1.data(), *b = back.data();
    const int32_t* steps = half_octaves.data();
    py::gil_scoped_release release;
    alignas(64) float weights[MOST_SIDE * ROW] = {0};
    window(taper, side, weights);
    for (py::ssize_t k = 0; k < count; ++k) {
        if (k + 1 < count) prefetch(images0[k + 1], p0 + 2 * k + 2), prefetch(image1, p1 + 2 * k + 2);
        examine_one(images0[k], image1, p0 + 2 * k, p1 + 2 * k, b + 4 * k, std::clamp(steps[k], -5, 5), side, flat,
                    weights, out + 6 * k);
    }
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

using Taps = std::array<float, 2 * REACH + 1>;

// (M, 2): mean squared first and second derivatives in patches around pixels (M, 2).
py::array_t<double> energies(const Grey& grey, const Steps& places, const Taps& taps) {
    const Image image = view(grey);
    const py::ssize_t count = places.size() / 2;
    py::array_t<double> result({count, py::ssize_t{2}});
    double* out = result.mutable_data();
    const int32_t* at = places.data();
    py::gil_scoped_release release;
    for (py::ssize_t k = 0; k < count; ++k) patch_energies(image, at[2 * k], at[2 * k + 1], taps.data(), out + 2 * k);
    return result;
}

// (9,): sums of products of derivatives, as of `sum_derivatives`.
py::array_t<double> derivative_products(const Grey& grey, const Taps& taps) {
    const Image image = view(grey);
    py::array_t<double> result(9);
    double* out = result.mutable_data();
    std::fill(out, out + 9, 0.0);
    py::gil_scoped_release release;
    if (image.width > 2 * BEYOND) sum_derivatives(image, taps.data(), out);
    return result;
}

// Points of the plane in square cells of a few each: those around a query are looked at ring by ring.
class Plane {
public:
    Plane(const Places& points, int nearest) : nearest_(nearest), found_(nearest), ranked_(nearest) {
        if (points.ndim() != 2 || points.shape(1) != 2) throw std::invalid_argument("points must be (N, 2)");
        const int count = static_cast<int>(points.shape(0));
        if (nearest < 1 || nearest > count) throw std::invalid_argument("there are fewer points");
        const float* from = points.data();
        float high[2] = {from[0], from[1]};
        low_[0] = from[0], low_[1] = from[1];
        for (int k = 0; k < 2 * count; ++k) {
            low_[k % 2] = std::min(low_[k % 2], from[k]), high[k % 2] = std::max(high[k % 2], from[k]);
        }
        const float wide = high[0] - low_[0], tall = high[1] - low_[1];
        if (!std::isfinite(wide + tall)) throw std::invalid_argument("points must be finite");
        // Not more cells than points, however thin the box is.
        side_ = std::max({std::sqrt(POINTS * wide * tall / count), std::max(wide, tall) / count, 1e-6f});
        cells_[0] = 1 + static_cast<int>(wide / side_), cells_[1] = 1 + static_cast<int>(tall / side_);
        begin_.assign(cells_[0] * cells_[1] + 1, 0);
        for (int k = 0; k < count; ++k) ++begin_[cell_of(from + 2 * k) + 1];
        std::partial_sum(begin_.begin(), begin_.end(), begin_.begin());
        points_.resize(count);
        std::vector<int> next(begin_.begin(), begin_.end() - 1);
        for (int k = 0; k < count; ++k) points_[next[cell_of(from + 2 * k)]++] = {from[2 * k], from[2 * k + 1], k};
    }

    // The nearest points to a place (u, v) by their numbers, the nearest first.
    const int* around(const float* place) {
        const int column = cell_of(place, 0), row = cell_of(place, 1);
        int size = 0;
        for (int ring = 0;; ++ring) {
            for (int r = std::max(row - ring, 0); r <= std::min(row + ring, cells_[1] - 1); ++r) {
                const int step = std::abs(r - row) == ring ? 1 : 2 * ring;  // of the rows between, the two ends
                for (int c = column - ring; c <= column + ring; c += step)
                    if (c >= 0 && c < cells_[0]) look_at(r * cells_[0] + c, place, size);
            }
            float reached = INFINITY;  // by all that was looked at
            for (int axis = 0; axis < 2; ++axis) {
                const int at = axis ? row : column;
                if (at > ring) reached = std::min(reached, place[axis] - (low_[axis] + (at - ring) * side_));
                if (at + ring + 1 < cells_[axis])
                    reached = std::min(reached, low_[axis] + (at + ring + 1) * side_ - place[axis]);
            }
            reached *= 0.999f;  // rounding
            const bool are_all = size == nearest_ && reached > 0.f && ranked_[size - 1] < rank(reached * reached, 0);
            if (reached != INFINITY && !are_all) continue;
            for (int k = 0; k < nearest_; ++k) found_[k] = static_cast<int>(ranked_[k] & UINT32_MAX);
            return found_.data();
        }
    }

private:
    static constexpr float POINTS = 3.f;  // of a cell

    struct Point {
        float u, v;
        int index;
    };

    int cell_of(const float* place, int axis) const {
        const float cell = (place[axis] - low_[axis]) / side_;
        return cell > 0.f ? static_cast<int>(std::min(cell, cells_[axis] - 1.f)) : 0;  // NaN is nowhere
    }
    int cell_of(const float* place) const { return cell_of(place, 1) * cells_[0] + cell_of(place, 0); }

    void look_at(int cell, const float* place, int& size) {
        for (int i = begin_[cell]; i < begin_[cell + 1]; ++i) {
            const float du = points_[i].u - place[0], dv = points_[i].v - place[1], square = du * du + dv * dv;
            const uint64_t one = rank(square, points_[i].index);
            if (size == nearest_ && one >= ranked_[size - 1]) continue;
            int k = size < nearest_ ? size++ : size - 1;
            for (; k > 0 && ranked_[k - 1] > one; --k) ranked_[k] = ranked_[k - 1];
            ranked_[k] = one;
        }
    }

    // Squared distance and number as one: what is not negative is in the order of its bits.
    static uint64_t rank(float square, int index) {
        uint32_t bits;
        std::memcpy(&bits, &square, sizeof bits);
        return static_cast<uint64_t>(bits) << 32 | static_cast<uint32_t>(index);
    }

    int nearest_, cells_[2];
    float low_[2], side_;
    std::vector<int> begin_, found_;
    std::vector<uint64_t> ranked_;
    std::vector<Point> points_;
};

// The median of an even or odd number of values: the ranks of few are counted faster than they are sorted.
double median(const double* values, int count) {
    double low = 0.0, high = 0.0;
    for (int i = 0; i < count; ++i) {
        int rank = 0;
        for (int j = 0; j < i; ++j) rank += values[j] <= values[i];
        for (int j = i + 1; j < count; ++j) rank += values[j] < values[i];
        if (rank == (count - 1) / 2) low = values[i];
        if (rank == count / 2) high = values[i];
    }
    return (low + high) / 2.0;
}

// (M, 3): median (u, v) of the departures (N, 2) of the points nearest to each query but for the first ones, and the
// median distance of these from that. With slopes (M, 2) a departure along u grows with the distance of starts (N, 2).
py::array_t<double> neighbour_medians(const Places& points, const Places& queries, const Reals& departures, int first,
                                      int count, const Reals& starts, const Reals& slopes) {
    const py::ssize_t size = queries.size() / 2;
    if (departures.size() != points.size() || count <= first || first < 0 || starts.size() != points.size() ||
        (slopes.size() && (slopes.size() != 2 * size || points.size() != 2 * size)))
        throw std::invalid_argument("all arrays must have a row for each point");
    Plane plane(points, count);
    py::array_t<double> result({size, py::ssize_t{3}});
    const double *from = departures.data(), *start = starts.data(), *slope = slopes.size() ? slopes.data() : nullptr;
    const float* at = queries.data();
    double* out = result.mutable_data();
    py::gil_scoped_release release;
    const int near = count - first;
    std::vector<double> us(near), vs(near), distances(near);
    for (py::ssize_t k = 0; k < size; ++k, out += 3) {
        const int* number = plane.around(at + 2 * k) + first;
        for (int i = 0; i < near; ++i) {
            us[i] = from[2 * number[i]], vs[i] = from[2 * number[i] + 1];
            if (slope)
                us[i] += (start[2 * number[i]] - start[2 * k]) * slope[2 * k] +
                         (start[2 * number[i] + 1] - start[2 * k + 1]) * slope[2 * k + 1];
        }
        out[0] = median(us.data(), near), out[1] = median(vs.data(), near);
        for (int i = 0; i < near; ++i) {
            const double u = us[i] - out[0], v = vs[i] - out[1];
            distances[i] = std::sqrt(u * u + v * v);
        }
        out[2] = median(distances.data(), near);
    }
    return result;
}

// (K, 2): gradients of the disparity (N,) around some of the points (N, 2) by their nearest others: `disparity_slopes`.
py::array_t<double> fit_slopes(const Reals& points, const Reals& disparities, const Steps& chosen, int near, double rough,
                               double steep, const std::vector<double>& scales) {
    if (points.size() != 2 * disparities.size()) throw std::invalid_argument("all arrays must have a row for each point");
    Plane plane(Places(points), near + 1);
    const py::ssize_t count = chosen.size();
    py::array_t<double> result({count, py::ssize_t{2}});
    const double *at = points.data(), *disparity = disparities.data();
    const int32_t* which = chosen.data();
    for (py::ssize_t k = 0; k < count; ++k)
        if (which[k] < 0 || which[k] >= disparities.size()) throw std::invalid_argument("there is no point of that number");
    double* out = result.mutable_data();
    py::gil_scoped_release release;
    std::vector<double> apart(2 * near), rise(near);
    for (py::ssize_t k = 0; k < count; ++k, out += 2) {
        const double *own = at + 2 * which[k], height = disparity[which[k]];
        const float place[2] = {static_cast<float>(own[0]), static_cast<float>(own[1])};
        const int* number = plane.around(place) + 1;
        for (int i = 0; i < near; ++i) {
            apart[2 * i] = at[2 * number[i]] - own[0], apart[2 * i + 1] = at[2 * number[i] + 1] - own[1];
            rise[i] = disparity[number[i]] - height;
        }
        out[0] = out[1] = 0.0;
        for (const double scale : scales) {
            double uu = 1.0 / (steep * steep), vv = uu, uv = 0.0, u = 0.0, v = 0.0;
            for (int i = 0; i < near; ++i) {
                const double du = apart[2 * i], dv = apart[2 * i + 1];
                const double rest = (rise[i] - (du * out[0] + dv * out[1])) / (rough * scale);
                const double bend = (1.0 + rest * rest) * rough, weight = 1.0 / (bend * bend);
                uu += weight * du * du, uv += weight * du * dv, vv += weight * dv * dv;
                u += weight * du * rise[i], v += weight * dv * rise[i];
            }
            const double determinant = uu * vv - uv * uv;
            out[0] = (vv * u - uv * v) / determinant;
            out[1] = (uu * v - uv * u) / determinant;
        }
    }
    return result;
}

// Ascending numbers of those centres (N, 2) that, by order (N,), lie on no disc about what is taken (K, 2) or came before.
py::array_t<int64_t> select_spaced(int height, int width, const Grey& disc, const Steps& taken, const Steps& centres,
                                   const Steps& order) {
    const Image stamp = view(disc);
    const py::ssize_t count = centres.size() / 2;
    if (height < 1 || width < 1 || order.size() != count) throw std::invalid_argument("an order has a row for each point");
    std::vector<uint8_t> occupied(static_cast<size_t>(height) * width);
    const auto occupy = [&](const int32_t* at) {
        const int left = at[0] - stamp.width / 2, top = at[1] - stamp.height / 2;
        for (int v = std::max(top, 0); v < std::min(top + stamp.height, height); ++v)
            for (int u = std::max(left, 0); u < std::min(left + stamp.width, width); ++u)
                occupied[static_cast<size_t>(v) * width + u] |= stamp.pixels[(v - top) * stamp.width + u - left];
    };
    for (py::ssize_t k = 0; k < taken.size() / 2; ++k) occupy(taken.data() + 2 * k);
    std::vector<int64_t> kept;
    for (py::ssize_t k = 0; k < count; ++k) {
        const int32_t number = order.data()[k];
        if (number < 0 || number >= count) throw std::invalid_argument("there is no point of that number");
        const int32_t* at = centres.data() + 2 * number;
        if (occupied[static_cast<size_t>(clamp(at[1], height - 1)) * width + clamp(at[0], width - 1)]) continue;
        kept.push_back(number);
        occupy(at);
    }
    std::sort(kept.begin(), kept.end());
    py::array_t<int64_t> result(kept.size());
    std::copy(kept.begin(), kept.end(), result.mutable_data());
    return result;
}

// Inverse of the part of a symmetric matrix whose rows are measured; the rest of it is zero. False where it is singular.
bool invert_measured(const double (&matrix)[3][3], const bool* measured, double (&inverse)[3][3]) {
    double m[3][3];
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) m[i][j] = measured[i] && measured[j] ? matrix[i][j] : i == j;
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) {
            const int a = (j + 1) % 3, b = (j + 2) % 3, c = (i + 1) % 3, d = (i + 2) % 3;
            inverse[i][j] = m[a][c] * m[b][d] - m[a][d] * m[b][c];
        }
    const double determinant = m[0][0] * inverse[0][0] + m[0][1] * inverse[1][0] + m[0][2] * inverse[2][0];
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) inverse[i][j] = measured[i] && measured[j] ? inverse[i][j] / determinant : 0.0;
    return determinant > 0.0;
}

// Stereo points (M, 3) of a key view as they were measured (M, 3) in another one: `linearise` of stereo_pose.py.
// Returns squared errors (M,), and by robust weights of the scale `loss` (squared) the normal matrix and gradient, (42,).
py::tuple stereo_equations(const std::array<double, 5>& camera, const Reals& landmarks, const Reals& sigmas,
                           const Reals& measurements, const Reals& noises, const Reals& weights, const Reals& pose,
                           double loss) {
    const py::ssize_t count = weights.size();
    check(count, {landmarks.size() / 3, sigmas.size() / 3, measurements.size() / 3, noises.size() / 9}, 3);
    if (pose.size() != 16) throw std::invalid_argument("a pose must be (4, 4)");
    const auto [fx, fy, cx, cy, focal] = camera;
    const double *T = pose.data(), *landmark = landmarks.data(), *sigma = sigmas.data();
    const double *measurement = measurements.data(), *noise = noises.data(), *weight = weights.data();
    py::array_t<double> squared(count), equations(42);
    double *error = squared.mutable_data(), *sums = equations.mutable_data();
    std::fill(sums, sums + 42, 0.0);
    for (py::ssize_t k = 0; k < count; ++k, landmark += 3, sigma += 3, measurement += 3, noise += 9) {
        const double ray[3] = {(landmark[0] - cx) / fx, (landmark[1] - cy) / fy, 1.0}, nearness = landmark[2] / focal;
        double seen[3];
        for (int i = 0; i < 3; ++i)
            seen[i] = T[4 * i] * ray[0] + T[4 * i + 1] * ray[1] + T[4 * i + 2] * ray[2] + nearness * T[4 * i + 3];
        error[k] = INFINITY;
        const auto [x, y, z] = seen;
        if (!(z > 1e-6)) continue;
        const double predicted[3] = {fx * x / z + cx, fy * y / z + cy, focal * nearness / z};
        const double by_seen[3][3] = {{fx / z, 0.0, -fx * x / (z * z)},
                                      {0.0, fy / z, -fy * y / (z * z)},
                                      {0.0, 0.0, -focal * nearness / (z * z)}};
        double residual[3], J[3][6], by_landmark[3][3], spread[3][3], information[3][3];
        bool measured[3];
        for (int i = 0; i < 3; ++i) {
            const double* row = by_seen[i];
            residual[i] = measurement[i] - predicted[i];
            measured[i] = std::isfinite(residual[i]);
            if (!measured[i]) residual[i] = 0.0;
            for (int j = 0; j < 3; ++j) {
                J[i][j] = row[j] * nearness;
                const double scale = j == 0 ? fx : j == 1 ? fy : focal;
                const int column = j == 2 ? 3 : j;
                by_landmark[i][j] = (row[0] * T[column] + row[1] * T[4 + column] + row[2] * T[8 + column]) / scale;
            }
            J[i][3] = row[2] * y - row[1] * z;
            J[i][4] = row[0] * z - row[2] * x;
            J[i][5] = row[1] * x - row[0] * y;
        }
        by_landmark[2][2] += 1.0 / z;
        for (int i = 0; i < 3; ++i)
            for (int j = 0; j < 3; ++j) {
                spread[i][j] = noise[3 * i + j];
                for (int l = 0; l < 3; ++l) spread[i][j] += by_landmark[i][l] * sigma[l] * sigma[l] * by_landmark[j][l];
            }
        if (!(measured[0] || measured[1] || measured[2]) || !invert_measured(spread, measured, information)) continue;
        double whitened[3], total = 0.0;
        for (int i = 0; i < 3; ++i) {
            whitened[i] = information[i][0] * residual[0] + information[i][1] * residual[1] + information[i][2] * residual[2];
            total += residual[i] * whitened[i];
        }
        error[k] = total;
        const double share = 1.0 + total / loss, robust = weight[k] / (share * share);
        for (int a = 0; a < 6; ++a) {
            for (int i = 0; i < 3; ++i) sums[36 + a] += robust * J[i][a] * whitened[i];
            for (int b = 0; b < 6; ++b)
                for (int i = 0; i < 3; ++i)
                    for (int j = 0; j < 3; ++j) sums[6 * a + b] += robust * J[i][a] * information[i][j] * J[j][b];
        }
    }
    return py::make_tuple(squared, equations);
}

// Means of squares of SIDE numbers.
template <int SIDE>
std::vector<float> means(const float* values, int height, int width) {
    std::vector<float> out(static_cast<size_t>(height / SIDE) * (width / SIDE));
    float* to = out.data();
    for (int i = 0; i < height; i += SIDE)
        for (const float *from = values + static_cast<size_t>(i) * width, *end = from + width; from < end; from += SIDE) {
            float total = 0.f;
            for (int r = 0; r < SIDE; ++r)
                for (int c = 0; c < SIDE; ++c) total += from[r * width + c];
            *to++ = total / static_cast<float>(SIDE * SIDE);
        }
    return out;
}

// What the response is measured against in each cell: `_surroundings` of models/sigmaslam_models/detector.py.
std::vector<float> surroundings(const std::vector<float>& response, int height, int width) {
    constexpr int WINDOW = 2;  // blocks to either side
    const int rows = height / CELL, columns = width / CELL;
    std::vector<float> cells(rows * columns);
    cell_means(response.data(), height, width, cells.data());
    // The outermost cells respond to the border of the image.
    for (int i = 0; i < rows; ++i)
        for (int j = 0; j < columns; ++j)
            cells[i * columns + j] = cells[std::clamp(i, 1, rows - 2) * columns + std::clamp(j, 1, columns - 2)];
    const std::vector<float> blocks = means<CELL>(cells.data(), rows, columns);
    const int high = rows / CELL, wide = columns / CELL;
    const float overall = std::accumulate(blocks.begin(), blocks.end(), 0.f) / static_cast<float>(blocks.size());
    std::vector<float> levels;
    for (int i = 0; i < high; ++i)
        for (int j = 0; j < wide; ++j) {
            float total = 0.f;
            int count = 0;
            for (int r = std::max(i - WINDOW, 0); r <= std::min(i + WINDOW, high - 1); ++r)
                for (int c = std::max(j - WINDOW, 0); c <= std::min(j + WINDOW, wide - 1); ++c, ++count) total += blocks[r * wide + c];
            const float root = std::sqrt(std::max(total / static_cast<float>(count) + 0.05f * overall, 1e-14f));
            levels.push_back(root * std::sqrt(root));  // to the power of 0.75
        }
    for (int i = 0; i < rows; ++i)
        for (int j = 0; j < columns; ++j) {
            const float v = std::max((i + 0.5f) / CELL - 0.5f, 0.f), u = std::max((j + 0.5f) / CELL - 0.5f, 0.f);
            const int r = static_cast<int>(v), c = static_cast<int>(u), s = std::min(r + 1, high - 1), d = std::min(c + 1, wide - 1);
            const float dv = v - static_cast<float>(r), du = u - static_cast<float>(c);
            const float above = (1.f - du) * levels[r * wide + c] + du * levels[r * wide + d];
            cells[i * columns + j] = (1.f - dv) * above + dv * ((1.f - du) * levels[s * wide + c] + du * levels[s * wide + d]);
        }
    return cells;
}

// Peak of the quadratic through 3x3 pixels: (u, v).
void fit_peak(const float* response, int width, int pixel, float* place) {
    const float *here = response + pixel, *above = here - width, *below = here + width;
    const float du = 0.5f * (here[1] - here[-1]), dv = 0.5f * (below[0] - above[0]);
    const float uu = here[1] - 2.f * here[0] + here[-1], vv = below[0] - 2.f * here[0] + above[0];
    const float uv = 0.25f * (below[1] - above[1] - below[-1] + above[-1]), determinant = uu * vv - uv * uv;
    const float scale = determinant > 1e-3f * std::fabs(uu * vv) ? 1.f / determinant : 0.f;
    place[0] = static_cast<float>(pixel % width) + std::clamp(-scale * (vv * du - uv * dv), -0.75f, 0.75f);
    place[1] = static_cast<float>(pixel / width) + std::clamp(-scale * (uu * dv - uv * du), -0.75f, 0.75f);
}

// The strongest blobs of an image, evened out over it: places (count, 2) and strengths (count,), zero where it has fewer.
py::tuple strongest_blobs(const float* image, int height, int width, int count) {
    static const std::vector<float> taps = [] {
        std::array<double, BLOB_REACH + 2> smooth{};
        double sum = 0.0;
        for (int t = 0; t < BLOB_REACH; ++t)
            sum += (t ? 2.0 : 1.0) * (smooth[t] = std::exp(-0.5 * t * t / (BLOB_SIGMA * BLOB_SIGMA)));
        std::vector<float> made(3 * (BLOB_REACH + 1));
        for (int t = 0; t <= BLOB_REACH; ++t) {
            const double before = smooth[std::abs(t - 1)] / sum, here = smooth[t] / sum, after = smooth[t + 1] / sum;
            made[t] = static_cast<float>(here);
            made[BLOB_REACH + 1 + t] = static_cast<float>(BLOB_SIGMA * 0.5 * (before - after));
            made[2 * (BLOB_REACH + 1) + t] = static_cast<float>(BLOB_SIGMA * BLOB_SIGMA * (before + after - 2.0 * here));
        }
        return made;
    }();
    std::vector<float> response(static_cast<size_t>(height) * width);
    blob_response(image, height, width, taps.data(), response.data());
    std::vector<Blob> blobs;
    find_maxima(response.data(), surroundings(response, height, width).data(), height, width, blobs);
    const size_t found = std::min(blobs.size(), static_cast<size_t>(count));
    const auto is_better = [](const Blob& a, const Blob& b) {
        return a.strength != b.strength ? a.strength > b.strength : a.pixel < b.pixel;
    };
    std::nth_element(blobs.begin(), blobs.begin() + found, blobs.end(), is_better);
    std::sort(blobs.begin(), blobs.begin() + found, is_better);
    Places places({count, 2}), strengths(count);
    std::fill_n(places.mutable_data(), 2 * count, 0.f);
    std::fill_n(strengths.mutable_data(), count, 0.f);
    for (size_t k = 0; k < found; ++k) {
        strengths.mutable_data()[k] = blobs[k].strength;
        fit_peak(response.data(), width, blobs[k].pixel, places.mutable_data() + 2 * k);
    }
    return py::make_tuple(places, strengths);
}

// Blobs of an image in [0, 1] and of its half, as `find_blobs` of models/sigmaslam_models/extractor.py gives them.
py::tuple find_blobs(const Places& image, int count) {
    if (image.ndim() != 2 || image.shape(0) % 32 || image.shape(1) % 32 || image.shape(0) < 96 || image.shape(1) < 96)
        throw std::invalid_argument("sides of the image must be multiples of 32, from 96 on");
    const int height = static_cast<int>(image.shape(0)), width = static_cast<int>(image.shape(1)), half = count / 4;
    const py::tuple large = strongest_blobs(image.data(), height, width, 2 * (count - half));
    const std::vector<float> halved = means<2>(image.data(), height, width);
    const py::tuple small = strongest_blobs(halved.data(), height / 2, width / 2, 2 * half);
    return py::make_tuple(large[0], large[1], small[0], small[1]);
}

}  // namespace

PYBIND11_MODULE(_kernels, module) {
    module.doc() = "Compiled twins of functions that sigmaslam.frontend.patch_kernels names.";
    module.def("align", &align);
    module.def("examine", &examine);
    module.def("search_rows", &search_rows);
    module.def("energies", &energies);
    module.def("derivative_products", &derivative_products);
    module.def("fit_slopes", &fit_slopes);
    module.def("select_spaced", &select_spaced);
    module.def("stereo_equations", &stereo_equations);
    module.def("neighbour_medians", &neighbour_medians);
    module.def("find_blobs", &find_blobs);
}
