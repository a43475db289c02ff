// The compiled twins of functions of depth_fusion.py and disparity.py, which say what is computed.
//
// No sum is contracted or reordered (-ffp-contract=off, no -ffast-math): the bits are the same on every run.
#include "../compiled.hpp"

using Reals = Array<float>;
using Doubles = Array<double>;
using Grey = Array<uint8_t>;
using Rows = Array<int64_t>;

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

#define FUNCTIONS "reconstruction/depths.inc"
#include "../both_ways.inc"

const auto measure_depths = HAS_AVX2 ? wide::measure_depths : plain::measure_depths;
const auto window_ratios = HAS_AVX2 ? wide::window_ratios : plain::window_ratios;
const auto find_agreeing = HAS_AVX2 ? wide::find_agreeing : plain::find_agreeing;
const auto update_filters = HAS_AVX2 ? wide::update_filters : plain::update_filters;
const auto align_windows = HAS_AVX2 ? wide::gauss_newton : plain::gauss_newton;
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

// weight, difference, its square and the warped image (H, W) of an image and what another view shows of N pixels.
py::tuple compare(const Grey& image, const Rows& known, const Reals& grey) {
    check(image.ndim() == 2 && grey.size() == known.size(), "an image must be (H, W), and each pixel have a grey value");
    for (py::ssize_t k = 0; k < known.size(); ++k)
        check(known.data()[k] >= 0 && known.data()[k] < image.size(), "a pixel is in no image");
    const std::array<py::ssize_t, 2> shape = {image.shape(0), image.shape(1)};
    py::array_t<float> out[3] = {py::array_t<float>(shape), py::array_t<float>(shape), py::array_t<float>(shape)};
    for (auto& each : out) std::fill(each.mutable_data(), each.mutable_data() + image.size(), 0.f);
    py::array_t<uint8_t> warped(shape);
    std::copy(image.data(), image.data() + image.size(), warped.mutable_data());
    compare_pixels(image.data(), {known.data(), static_cast<size_t>(known.size())}, grey.data(), out[0].mutable_data(),
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

// Increasing numbers of the most certain pixel of each voxel, the first of equals: `DepthPixels.thinned`.
Rows thin(const Rows& pixels, const Doubles& disparity, const Doubles& variance, const std::array<double, 5>& camera, double size,
          double sigma_share, int most_level) {
    const py::ssize_t n = disparity.size();
    check(pixels.size() == 2 * n && variance.size() == n, "all arrays must have a number for each pixel");
    const auto [fx, fy, cx, cy, focal_baseline] = camera;
    std::vector<double> sides;
    for (int level = 0; level <= most_level; ++level) sides.push_back(std::ldexp(size, level));
    size_t slots = 64;
    while (slots < 2 * static_cast<size_t>(n)) slots *= 2;
    // Of each slot the voxel that is there, counted from one, and of each voxel its key and its best pixel.
    std::vector<uint32_t> table(slots);
    std::vector<int64_t> keys, rows;
    std::vector<double> least;
    for (py::ssize_t k = 0; k < n; ++k) {
        const double d = disparity.data()[k], z = focal_baseline / d, relative = variance.data()[k] / (d * d);
        const double x = (pixels.data()[2 * k] - cx) * z / fx, y = (pixels.data()[2 * k + 1] - cy) * z / fy;
        const double wanted = sigma_share * std::sqrt((x * x + y * y + z * z) * relative);
        int level = 0;
        while (level < most_level && sides[level] < wanted) ++level;
        const double scale = 1.0 / sides[level];
        int64_t key = static_cast<int64_t>(level) << 57;
        key += static_cast<int64_t>(std::floor(x * scale)) + static_cast<int64_t>(std::floor(y * scale)) * (int64_t{1} << 19);
        key += static_cast<int64_t>(std::floor(z * scale)) * (int64_t{1} << 38);
        size_t slot = (static_cast<uint64_t>(key) * 0x9e3779b97f4a7c15u) >> 20 & (slots - 1);
        while (table[slot] && keys[table[slot] - 1] != key) slot = (slot + 1) & (slots - 1);
        if (!table[slot]) {
            keys.push_back(key);
            rows.push_back(k);
            least.push_back(relative);
            table[slot] = static_cast<uint32_t>(keys.size());
        } else if (relative < least[table[slot] - 1]) {
            rows[table[slot] - 1] = k;
            least[table[slot] - 1] = relative;
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
    module.def("compare", &compare);
    module.def("gauss_newton", &gauss_newton);
    module.def("thin", &thin);
}
