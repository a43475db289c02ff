// Views of landmarks, linearised and weighed: the compiled twin of sigmaslam_models/estimator/view_functions.py, of
// which views.inc is written. No contraction, no reordering: the same bits on every run.
#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>

#include <stdexcept>
#include <vector>

namespace py = pybind11;

namespace {

#include "views.inc"

using Reals = py::array_t<double, py::array::c_style | py::array::forcecast>;
using Index = py::array_t<int64_t, py::array::c_style | py::array::forcecast>;
using Function = void (*)(void**, void**, int64_t, int64_t);

// Numbers of one view of an array, and whether all views share them.
struct Given {
    const Reals& array;
    py::ssize_t size;
    bool shared;
};

py::ssize_t check(const Reals& array, py::ssize_t views, py::ssize_t size) {
    if (array.size() != views * size) throw std::invalid_argument("an array has another size than its views ask for");
    return size;
}

// Calls a function view by view.
py::tuple for_views(Function function, py::ssize_t views, const std::vector<Given>& given,
                    const std::vector<std::vector<py::ssize_t>>& shapes, const Index* pair = nullptr) {
    std::vector<Reals> made;
    std::vector<py::ssize_t> sizes;
    for (const auto& shape : shapes) {
        std::vector<py::ssize_t> whole{views};
        py::ssize_t size = 1;
        for (const auto length : shape) whole.push_back(length), size *= length;
        made.emplace_back(whole);
        sizes.push_back(size);
    }
    std::vector<double*> from, to;
    for (const auto& each : given) from.push_back(const_cast<double*>(each.array.data()));
    for (auto& each : made) to.push_back(each.mutable_data());
    const int64_t* pairs = pair ? pair->data() : nullptr;
    {
        py::gil_scoped_release release;
        std::vector<void*> in(from.size()), out(to.size());
        for (py::ssize_t view = 0; view < views; ++view) {
            for (size_t k = 0; k < from.size(); ++k) {
                const py::ssize_t place = given[k].shared ? 0 : k == 0 && pairs ? pairs[view] : view;
                in[k] = from[k] + place * given[k].size;
            }
            for (size_t k = 0; k < to.size(); ++k) out[k] = to[k] + view * sizes[k];
            function(in.data(), out.data(), 1, 1);
        }
    }
    py::tuple result(made.size());
    for (size_t k = 0; k < made.size(); ++k) result[k] = std::move(made[k]);
    return result;
}

py::tuple see_views(const Reals& pairs, const Index& pair, const Reals& calibration, const Reals& intrinsics,
                    const Reals& landmarks, const Reals& covariance, const Reals& common) {
    const py::ssize_t views = pair.size();
    if (pairs.ndim() != 2) throw std::invalid_argument("pairs are rows of an array");
    for (py::ssize_t view = 0; view < views; ++view)
        if (pair.data()[view] < 0 || pair.data()[view] >= pairs.shape(0))
            throw std::out_of_range("a view names a pair of poses that is not there");
    return for_views(see, views,
                     {{pairs, check(pairs, pairs.shape(0), 210), false},
                      {calibration, check(calibration, 1, 12), true},
                      {intrinsics, check(intrinsics, 1, 5), true},
                      {landmarks, check(landmarks, views, 6), false},
                      {covariance, check(covariance, views, 36), false},
                      {common, check(common, views, 6), false}},
                     {{3}, {3, 18}, {3, 6}, {3, 3}, {3, 3}, {}}, &pair);
}

py::tuple weigh_views(const Reals& measurement, const Reals& mean, const Reals& noise, const Reals& by_pair,
                      const Reals& by_landmark) {
    const py::ssize_t views = measurement.shape(0);
    return for_views(weigh, views,
                     {{measurement, check(measurement, views, 3), false},
                      {mean, check(mean, views, 3), false},
                      {noise, check(noise, views, 9), false},
                      {by_pair, check(by_pair, views, 54), false},
                      {by_landmark, check(by_landmark, views, 18), false}},
                     {{3, 25}, {}});
}

// Derivatives of views by the state (M, 3, n): by pairs of poses through their chain (p, 9, n), by the calibration's
// other errors, and where the landmarks depend on the state (M, 6, n), through them.
Reals by_state(const Reals& by_pair, const Index& pair, const Reals& chain, const Reals& by_landmark,
               const py::object& dependence) {
    const py::ssize_t views = pair.size(), n = chain.shape(2);
    check(by_pair, views, 54), check(by_landmark, views, 18), check(chain, chain.shape(0), 9 * n);
    const bool moves = !dependence.is_none();
    const Reals moved = moves ? dependence.cast<Reals>() : Reals();
    if (moves) check(moved, views, 6 * n);
    for (py::ssize_t view = 0; view < views; ++view)
        if (pair.data()[view] < 0 || pair.data()[view] >= chain.shape(0))
            throw std::out_of_range("a view names a pair of poses that is not there");
    Reals made({views, py::ssize_t{3}, n});
    const double *pairs = by_pair.data(), *chains = chain.data(), *landmarks = by_landmark.data();
    const double* depends = moves ? moved.data() : nullptr;
    const int64_t* which = pair.data();
    double* out = made.mutable_data();
    py::gil_scoped_release release;
    for (py::ssize_t row = 0; row < 3 * views; ++row, out += n) {
        const py::ssize_t view = row / 3;
        std::fill_n(out, n, 0.0);
        for (int k = 0; k < 9; ++k) {
            const double slope = pairs[18 * row + k];
            const double* from = chains + (9 * which[view] + k) * n;
            for (py::ssize_t c = 0; c < n; ++c) out[c] += slope * from[c];
        }
        for (int k = 0; k < 9; ++k) out[3 + k] += pairs[18 * row + 9 + k];
        for (int k = 0; moves && k < 6; ++k) {
            const double slope = landmarks[6 * row + k];
            const double* from = depends + (6 * view + k) * n;
            for (py::ssize_t c = 0; c < n; ++c) out[c] += slope * from[c];
        }
    }
    return made;
}

// Of each landmark the sum over its views of A^T [A, B], for A (O, 3, 6) and B (O, 3, n); (L, 6, 6 + n).
Reals sum_by_landmark(const Reals& left, const Reals& right, const Index& owner, py::ssize_t count) {
    const py::ssize_t views = owner.size(), n = right.shape(2), width = 6 + n;
    check(left, views, 18), check(right, views, 3 * n);
    for (py::ssize_t view = 0; view < views; ++view)
        if (owner.data()[view] < 0 || owner.data()[view] >= count)
            throw std::out_of_range("a view names a landmark that is not there");
    Reals made({count, py::ssize_t{6}, width});
    const double *a = left.data(), *b = right.data();
    const int64_t* which = owner.data();
    double* out = made.mutable_data();
    py::gil_scoped_release release;
    std::fill_n(out, count * 6 * width, 0.0);
    for (py::ssize_t row = 0; row < 3 * views; ++row) {
        for (int i = 0; i < 6; ++i) {
            const double slope = a[6 * row + i];
            double* to = out + (6 * which[row / 3] + i) * width;
            for (int c = 0; c < 6; ++c) to[c] += slope * a[6 * row + c];
            for (py::ssize_t c = 0; c < n; ++c) to[6 + c] += slope * b[n * row + c];
        }
    }
    return made;
}

}  // namespace

PYBIND11_MODULE(_views, module) {
    module.def("see_views", &see_views);
    module.def("weigh_views", &weigh_views);
    module.def("by_state", &by_state);
    module.def("sum_by_landmark", &sum_by_landmark);
}
