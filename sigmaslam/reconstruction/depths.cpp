// The compiled twins of functions of depth_fusion.py and disparity.py, which say what is computed.
//
// No sum is contracted or reordered (-ffp-contract=off, no -ffast-math): the bits are the same on every run.
#include "../compiled.hpp"

#include <memory>

using Reals = Array<float>;
using Doubles = Array<double>;
using Grey = Array<uint8_t>;
using Rows = Array<int64_t>;
using Counts = Array<int32_t>;

namespace {

constexpr int RADIUS = 3;  // of the window of an alignment
constexpr float OUTSIDE = -1e4f, LEAST_WEIGHT = 1e-3f;
constexpr float ROUNDING = 1.f / 6.f, RESAMPLING = 1.f / 12.f;

struct View {
    const float *sampled, *image;
    int height, width;
};

struct Camera {
    float fx, fy, cx, cy, focal_baseline, least_depth;
};

struct Pixels {
    const int64_t* known;
    size_t count;
};

struct Gates {
    float shared, gate, gate_2d, flow_scale, flow_variance;
};

// States of pixels, or where they go.
struct Filter {
    float *mean, *variance, *cost;
    const float* common;
    uint8_t *support, *contradictions;
};

struct Limits {
    float prior_variance, widest_bound, rounding, most_gain, longest;
};

// Of a variance: what marks pixels without a disparity, limits of relief and edge, the floor, and factors.
struct Spread {
    float nowhere, same_surface, widest_edge, floor, by_bound, by_relief, by_edge;
};

#define FUNCTIONS "reconstruction/depths.inc"
#include "../both_ways.inc"

const auto measure_depths = HAS_AVX2 ? wide::measure_depths : plain::measure_depths;
const auto window_ratios = HAS_AVX2 ? wide::window_ratios : plain::window_ratios;
const auto find_agreeing = HAS_AVX2 ? wide::find_agreeing : plain::find_agreeing;
const auto update_filters = HAS_AVX2 ? wide::update_filters : plain::update_filters;
const auto align_windows = HAS_AVX2 ? wide::gauss_newton : plain::gauss_newton;
const auto sum_variances = HAS_AVX2 ? wide::sum_variances : plain::sum_variances;
const auto sample_planes = HAS_AVX2 ? wide::sample_planes : plain::sample_planes;
const auto compare_pixels = HAS_AVX2 ? wide::compare : plain::compare;

void check(bool right, const char* what) {
    if (!right) throw std::invalid_argument(what);
}

// (7, N) what another view measures of N pixels, as `_Seen` has it.
py::array_t<float> measure(const Reals& sampled, const Reals& image, const Reals& camera, const Reals& pose,
                           const Reals& products, const Reals& rays, const Reals& state, const Reals& variance) {
    check(image.ndim() == 2 && sampled.size() == 4 * image.size(), "a view must be (H, W) and (H, W, 4)");
    check(camera.size() == 6 && pose.size() == 12 && products.size() == 60, "a camera has 6 numbers, a step 12 and 60");
    const py::ssize_t n = state.size();
    check(rays.size() == 3 * n && variance.size() == n, "all arrays must have a number for each pixel");
    const View view{sampled.data(), image.data(), static_cast<int>(image.shape(0)), static_cast<int>(image.shape(1))};
    const float* c = camera.data();
    py::array_t<float> out({py::ssize_t{7}, n});
    measure_depths(view, {c[0], c[1], c[2], c[3], c[4], c[5]}, pose.data(), products.data(), rays.data(), state.data(),
                   variance.data(), n, out.mutable_data());
    return out;
}

// The median as NumPy has it, 0 of none.
float median(std::vector<float>& values) {
    if (values.empty()) return 0.f;
    const auto middle = values.begin() + values.size() / 2;
    std::nth_element(values.begin(), middle, values.end());
    if (values.size() % 2) return *middle;
    return 0.5f * (*std::max_element(values.begin(), middle) + *middle);
}

// mean, variance, cost, support and contradictions of N pixels after a view: the rest of `_take_view`.
py::tuple update(const Rows& known, const Reals& seen, const std::vector<Reals>& windows, const std::vector<Reals>& texture,
                 const std::vector<Reals>& flow, const std::array<float, 5>& gates, int stride, float least_share,
                 const Reals& mean, const Reals& variance, const Reals& common, const Reals& cost, const Grey& support,
                 const Grey& contradictions) {
    const py::ssize_t n = known.size();
    check(windows.size() == 3 && texture.size() == 2 && flow.size() == 2, "there are three windows, two textures and flows");
    const py::ssize_t pixels = windows[0].size();
    for (const auto& each : {windows[1], windows[2], flow[0], flow[1]}) check(each.size() == pixels, "images have one size");
    for (py::ssize_t k = 0; k < n; ++k) check(known.data()[k] >= 0 && known.data()[k] < pixels, "a pixel is in no image");
    for (const auto& each : {texture[0], texture[1], mean, variance, common, cost})
        check(each.size() == n, "all arrays must have a number for each pixel");
    check(seen.size() == 7 * n && support.size() == n && contradictions.size() == n && stride > 0, "wrong sizes");
    const Pixels at{known.data(), static_cast<size_t>(n)};
    const Gates by{gates[0], gates[1], gates[2], gates[3], gates[4]};
    const float* window[3] = {windows[0].data(), windows[1].data(), windows[2].data()};
    const float* textures[2] = {texture[0].data(), texture[1].data()};
    const float* flows[2] = {flow[0].data(), flow[1].data()};
    std::vector<float> ratio(n), expected(n), some;
    std::vector<uint8_t> there(n), agrees(n);
    const float* innovation = seen.data() + n;
    window_ratios(at, window, textures, seen.data() + 5 * n, seen.data() + 6 * n, ratio.data());
    for (py::ssize_t k = 0; k < n; k += stride)
        if (std::isfinite(innovation[k]) && !std::isnan(ratio[k])) some.push_back(ratio[k]);
    const auto alter = [](const auto& array) { return const_cast<std::decay_t<decltype(*array.data())>*>(array.data()); };
    const Filter filter{alter(mean), alter(variance), alter(cost), common.data(), alter(support), alter(contradictions)};
    const auto found = find_agreeing(at, by, seen.data(), ratio.data(), by.gate * median(some), flows, filter,
                                     expected.data(), there.data(), agrees.data());
    // Most of the image moves against the pose: it is that of a moving body, and confirms nothing at rest.
    if (static_cast<double>(found[1]) < least_share * static_cast<double>(found[0])) std::fill(agrees.begin(), agrees.end(), 0);
    py::array_t<float> means(n), variances(n), costs(n);
    py::array_t<uint8_t> supports(n), contradicted(n);
    const Filter to{means.mutable_data(), variances.mutable_data(), costs.mutable_data(), nullptr,
                    supports.mutable_data(), contradicted.mutable_data()};
    update_filters(n, by, seen.data(), expected.data(), there.data(), agrees.data(), filter, to);
    return py::make_tuple(means, variances, costs, supports, contradicted);
}

// (H, W) variance of disparities, after alignment.
Reals variance(const Reals& found, const Reals& departs, const Reals& smooth, const Reals& bound, const std::array<float, 7>& by) {
    check(found.ndim() == 2 && found.shape(0) > RADIUS && found.shape(1) > RADIUS, "an image is too small");
    for (const auto* each : {&departs, &smooth, &bound}) check(each->size() == found.size(), "images have one size");
    Reals out({found.shape(0), found.shape(1)});
    std::vector<float> rows(3 * (found.shape(1) + 2 * RADIUS + 8));
    sum_variances(found.data(), departs.data(), smooth.data(), bound.data(), static_cast<int>(found.shape(0)),
                  static_cast<int>(found.shape(1)), {by[0], by[1], by[2], by[3], by[4], by[5], by[6]}, rows.data(),
                  out.mutable_data());
    return out;
}

// (H, W, 4) disparity, its variance, and its slopes by u and v.
Reals sample_view(const Reals& disparity, const Reals& variance) {
    check(disparity.ndim() == 2 && variance.size() == disparity.size(), "images have one size");
    const py::ssize_t height = disparity.shape(0), width = disparity.shape(1);
    Reals out({height, width, py::ssize_t{4}});
    std::vector<float> rows(5 * (width + 2 * RADIUS + 8));
    sample_planes(disparity.data(), variance.data(), static_cast<int>(height), static_cast<int>(width), rows.data(),
                  out.mutable_data());
    return out;
}

// Means of weight, difference and its square, and the warped image (H, W), of an image and what another view shows of N
// pixels.
py::tuple compare(const Grey& image, const Rows& known, const Reals& grey) {
    check(image.ndim() == 2 && grey.size() == known.size(), "an image must be (H, W), and each pixel have a grey value");
    check(image.shape(0) > RADIUS && image.shape(1) > RADIUS, "an image is too small");
    for (py::ssize_t k = 0; k < known.size(); ++k)
        check(known.data()[k] >= 0 && known.data()[k] < image.size(), "a pixel is in no image");
    const std::array<py::ssize_t, 2> shape = {image.shape(0), image.shape(1)};
    py::array_t<float> out[3] = {py::array_t<float>(shape), py::array_t<float>(shape), py::array_t<float>(shape)};
    py::array_t<uint8_t> warped(shape);
    std::copy(image.data(), image.data() + image.size(), warped.mutable_data());
    std::vector<float> there(image.size()), differs(image.size()), rows(3 * (shape[1] + 2 * RADIUS + 8));
    compare_pixels(image.data(), {known.data(), static_cast<size_t>(known.size())}, grey.data(), static_cast<int>(shape[0]),
                   static_cast<int>(shape[1]), there.data(), differs.data(), rows.data(), out[0].mutable_data(),
                   out[1].mutable_data(), out[2].mutable_data(), warped.mutable_data());
    return py::make_tuple(out[0], out[1], out[2], warped);
}

// moved and bound (H, W) of images of that size.
py::tuple gauss_newton(const Reals& reference, const Reals& warped, const Reals& slope, const Reals& weight,
                       const std::array<float, 5>& limits) {
    check(reference.ndim() == 2 && reference.shape(0) > RADIUS && reference.shape(1) > RADIUS, "an image is too small");
    for (const auto* each : {&warped, &slope, &weight}) check(each->size() == reference.size(), "images have one size");
    const std::array<py::ssize_t, 2> shape = {reference.shape(0), reference.shape(1)};
    py::array_t<float> moved(shape), bound(shape);
    std::vector<float> difference(reference.size()), steep(reference.size()), inverses(reference.size());
    std::vector<float> rows(5 * (shape[1] + 2 * RADIUS + 8));
    align_windows(reference.data(), warped.data(), slope.data(), weight.data(), static_cast<int>(shape[0]),
                  static_cast<int>(shape[1]), {limits[0], limits[1], limits[2], limits[3], limits[4]}, difference.data(),
                  steep.data(), inverses.data(), rows.data(), moved.mutable_data(), bound.mutable_data());
    return py::make_tuple(moved, bound);
}

// The next lower whole number; without SSE4.1 std::floor is a call.
INLINE int64_t whole(double value) {
    const auto cut = static_cast<int64_t>(value);
    return cut - (static_cast<double>(cut) > value);
}

// Voxels of a size and those twice, four times ... as wide.
struct Grid {
    Grid(double size, double sigma_share, int most_level) : share(sigma_share), most(most_level) {
        for (int level = 0; level <= most_level; ++level) sides.push_back(std::ldexp(size, level));
    }
    // How often the side is doubled for a point of such a sigma.
    int level(double sigma) const {
        int found = 0;
        while (found < most && sides[found] < share * sigma) ++found;
        return found;
    }
    // Packed coordinates and level, as `_ONE_KEY` of cloud.py packs them.
    int64_t key(double x, double y, double z, int level) const {
        const double scale = 1.0 / sides[level];
        return whole(x * scale) + whole(y * scale) * (int64_t{1} << 19) + whole(z * scale) * (int64_t{1} << 38) +
               level * (int64_t{1} << 57);
    }
    double share;
    int most;
    std::vector<double> sides;
};

// Numbers of different keys, counted from zero in the order in which they come.
class Numbers {
public:
    explicit Numbers(size_t expected = 16) { resize(expected); }

    // The number of a key, and whether it is new.
    std::pair<size_t, bool> find(int64_t key) {
        if (2 * keys.size() >= slots_.size()) resize(2 * slots_.size());
        const size_t slot = place(key);
        if (slots_[slot]) return {slots_[slot] - 1, false};
        keys.push_back(key);
        slots_[slot] = static_cast<uint32_t>(keys.size());
        return {keys.size() - 1, true};
    }
    void prefetch(int64_t key) const { __builtin_prefetch(&slots_[start(key)]); }
    // Likely that of a key, one of others or `none`.
    size_t guess(int64_t key, size_t none) const { return slots_[start(key)] ? slots_[start(key)] - 1 : none; }
    std::vector<int64_t> keys;

private:
    size_t start(int64_t key) const { return (static_cast<uint64_t>(key) * 0x9e3779b97f4a7c15u) >> 20 & (slots_.size() - 1); }
    size_t place(int64_t key) const {
        size_t slot = start(key);
        while (slots_[slot] && keys[slots_[slot] - 1] != key) slot = (slot + 1) & (slots_.size() - 1);
        return slot;
    }
    void resize(size_t expected) {
        size_t size = 64;
        while (size < 2 * expected) size *= 2;
        slots_.assign(size, 0);
        for (size_t k = 0; k < keys.size(); ++k) slots_[place(keys[k])] = static_cast<uint32_t>(k + 1);
    }
    std::vector<uint32_t> slots_;  // counted from one
};

// Sums of what falls into each voxel, as the class of this name in cloud.py has them.
class Voxels {
public:
    Voxels(double size, double sigma_share, int most_level) : grid_(size, sigma_share, most_level) {}

    // Points (N, 3) with covariances (N, 6), sigmas without the pose's, colours (N, 3) and views (N,).
    void add(const Doubles& points, const Reals& covariances, const Doubles& sigma, const Reals& colours, const Counts& views) {
        const py::ssize_t n = sigma.size();
        check(points.size() == 3 * n && covariances.size() == 6 * n && colours.size() == 3 * n && views.size() == n,
              "all arrays must have a row for each point");
        constexpr py::ssize_t ahead = 16;  // rows whose sums are on their way from memory, and twice as many slots
        std::vector<int64_t> keys(n);
        std::vector<uint8_t> levels(n);
        for (py::ssize_t k = 0; k < n; ++k) {
            const double* p = points.data() + 3 * k;
            levels[k] = static_cast<uint8_t>(grid_.level(sigma.data()[k]));
            keys[k] = grid_.key(p[0], p[1], p[2], levels[k]);
        }
        for (py::ssize_t k = 0; k < n; ++k) {
            if (k + 2 * ahead < n) numbers_.prefetch(keys[k + 2 * ahead]);
            if (k + ahead < n && count()) {
                const size_t number = numbers_.guess(keys[k + ahead], 0);
                __builtin_prefetch(&numbers_.keys[number]);
                for (int line = 0; line < SUMS; line += 8) __builtin_prefetch(row(number) + line);
            }
            const double* p = points.data() + 3 * k;
            const float* six = covariances.data() + 6 * k;
            const double xx = six[0], xy = six[1], xz = six[2], yy = six[3], yz = six[4], zz = six[5];
            // The inverse, from its cofactors.
            double sums[SUMS] = {yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy,
                                 xx * zz - xz * xz, xy * xz - xx * yz, xx * yy - xy * xy};
            const double determinant = xx * sums[0] + xy * sums[1] + xz * sums[2];
            for (int i = 0; i < 6; ++i) sums[i] /= determinant;
            sums[6] = sums[0] * p[0] + sums[1] * p[1] + sums[2] * p[2];
            sums[7] = sums[1] * p[0] + sums[3] * p[1] + sums[4] * p[2];
            sums[8] = sums[2] * p[0] + sums[4] * p[1] + sums[5] * p[2];
            for (int i = 0; i < 3; ++i) sums[9 + i] = static_cast<double>(colours.data()[3 * k + i]) * views.data()[k];
            sums[12] = views.data()[k];
            add_row(keys[k], levels[k], sums);
        }
    }

    // Rows as `rows` gives them.
    void merge(const Rows& keys, const Grey& levels, const Doubles& sums) {
        const py::ssize_t n = keys.size();
        check(levels.size() == n && sums.size() == SUMS * n, "all arrays must have a row for each voxel");
        for (py::ssize_t k = 0; k < n; ++k) add_row(keys.data()[k], levels.data()[k], sums.data() + SUMS * k);
    }

    // Packed voxels and their levels (M,), and sums (M, 13), of those that so many views or more gave.
    py::tuple rows(double min_views) const {
        std::vector<size_t> chosen;
        for (size_t k = 0; k < count(); ++k)
            if (row(k)[12] >= min_views) chosen.push_back(k);
        const auto n = static_cast<py::ssize_t>(chosen.size());
        Rows keys(n);
        Grey levels(n);
        Doubles sums({n, py::ssize_t{SUMS}});
        for (py::ssize_t k = 0; k < n; ++k) {
            keys.mutable_data()[k] = numbers_.keys[chosen[k]];
            levels.mutable_data()[k] = levels_[chosen[k]];
            std::copy_n(row(chosen[k]), SUMS, sums.mutable_data() + SUMS * k);
        }
        return py::make_tuple(keys, levels, sums);
    }

    size_t count() const { return numbers_.keys.size(); }

private:
    static constexpr int SUMS = 13;
    static constexpr size_t BLOCK = 1 << 14;  // rows that are allocated at once and never moved

    double* row(size_t number) const { return blocks_[number / BLOCK].get() + SUMS * (number % BLOCK); }

    void add_row(int64_t key, uint8_t level, const double* sums) {
        const auto [number, is_new] = numbers_.find(key);
        if (is_new) {
            levels_.push_back(level);
            if (number % BLOCK == 0) blocks_.emplace_back(new double[SUMS * BLOCK]);
            std::copy_n(sums, SUMS, row(number));
            return;
        }
        double* to = row(number);
        for (int i = 0; i < SUMS; ++i) to[i] += sums[i];
    }

    Grid grid_;
    std::vector<std::unique_ptr<double[]>> blocks_;
    std::vector<uint8_t> levels_;
    Numbers numbers_;
};

// Increasing numbers of the most certain pixel of each voxel, the first of equals: `DepthPixels.thinned`.
Rows thin(const Rows& pixels, const Doubles& disparity, const Doubles& variance, const std::array<double, 5>& camera, double size,
          double sigma_share, int most_level) {
    const py::ssize_t n = disparity.size();
    check(pixels.size() == 2 * n && variance.size() == n, "all arrays must have a number for each pixel");
    const auto [fx, fy, cx, cy, focal_baseline] = camera;
    const Grid grid(size, sigma_share, most_level);
    Numbers voxels(static_cast<size_t>(n) / 2);
    std::vector<int64_t> rows;
    std::vector<double> least;
    for (py::ssize_t k = 0; k < n; ++k) {
        const double d = disparity.data()[k], z = focal_baseline / d, relative = variance.data()[k] / (d * d);
        const double x = (pixels.data()[2 * k] - cx) * z / fx, y = (pixels.data()[2 * k + 1] - cy) * z / fy;
        const int level = grid.level(std::sqrt((x * x + y * y + z * z) * relative));
        const auto [number, is_new] = voxels.find(grid.key(x, y, z, level));
        if (is_new) {
            rows.push_back(k);
            least.push_back(relative);
        } else if (relative < least[number]) {
            rows[number] = k;
            least[number] = relative;
        }
    }
    std::sort(rows.begin(), rows.end());
    return Rows(static_cast<py::ssize_t>(rows.size()), rows.data());
}

}  // namespace

PYBIND11_MODULE(_depths, module) {
    module.doc() = "Compiled twins of functions of sigmaslam.reconstruction.";
    module.def("measure", &measure);
    module.def("update", &update);
    module.def("variance", &variance);
    module.def("sample_view", &sample_view);
    module.def("compare", &compare);
    module.def("gauss_newton", &gauss_newton);
    module.def("thin", &thin);
    py::class_<Voxels>(module, "Voxels")
        .def(py::init<double, double, int>())
        .def("add", &Voxels::add)
        .def("merge", &Voxels::merge)
        .def("rows", &Voxels::rows)
        .def("__len__", &Voxels::count);
}
