// The estimator's steps, compiled: the twin of its graphs, whose names, inputs and outputs it has.
//
// What is done for each view is in views.inc, which is made from the torch modules that the graphs are made from; the
// sums over views and the small solutions around it are in estimator.inc. The compiler may not contract or reorder
// (-ffp-contract=off, no -ffast-math), and sums have a fixed order, so the bits are the same on every run.
#include "../compiled.hpp"

using Reals = Array<double>;
using Flags = Array<bool>;
using Integers = Array<int64_t>;

namespace {

// Errors of the calibration in the state; with both poses what a view says something of.
constexpr int CALIBRATION = 15, VIEW_TURNS = 3, PART = CALIBRATION + 12;

constexpr int MOTION = 12, SENSED = 43;     // pose and twist; with an inertial sensor
constexpr double PIVOT_TOLERANCE = 1e-13;  // of `plain_factors`

// Rows and columns are filled up with zeros to multiples of eight.
struct Matrix {
    int rows = 0, width = 0;
    std::vector<double> entries;

    Matrix() = default;
    Matrix(int rows_, int columns)
        : rows(rows_), width((columns + 7) / 8 * 8), entries(static_cast<size_t>((rows_ + 7) / 8 * 8) * width) {}
    double* at(int row) { return entries.data() + static_cast<size_t>(row) * width; }
    const double* at(int row) const { return entries.data() + static_cast<size_t>(row) * width; }
};

// `stereo_views.Scene`, and poses and calibration.
struct Scene {
    const double *intrinsics, *common, *covariance, *estimate, *poses, *calibration, *measurement, *noise;
    const int64_t *anchors, *views, *pair;
    double depth, unscented;
    int pairs, count, state;
};

struct Frame : Scene {
    const double* dependence;
    const int64_t* rows;  // of the dependence, that views have; null: one after the other
    Matrix factor;

    const double* depends(int view) const { return dependence + 6 * (rows ? rows[view] : view) * state; }
};

struct Window : Scene {
    const int64_t* owner;
    const double* spread;
    double freedom;
    int landmarks;
};

struct Step {
    Matrix offset, spread;
    std::vector<double> moved, squared, scores, score;
    std::vector<bool> agree;
    double usable = 0.0, count = 0.0, noise_scale = 0.0, prior_cost = 0.0;
    Matrix common, information;
};

// Of the state, its vector the last column; of the landmarks by the state (6 L, n + 1), solved, and by themselves.
struct Equations {
    Matrix information, sums, solved;
    std::vector<double> own;
};

#define FUNCTIONS "estimation/estimator.inc"
#include "../both_ways.inc"

// Arrays by name, kept while their numbers are used.
class Feed {
public:
    explicit Feed(const py::dict& feed) : feed_(feed) {}

    template <typename Given = Reals> auto* numbers(const char* name) { return array<Given>(name).data(); }
    double number(const char* name) { return *numbers(name); }
    bool has(const char* name) const { return feed_.contains(name); }
    int length(const char* name, int axis = 0) { return static_cast<int>(array<Reals>(name).shape(axis)); }

    Matrix matrix(const char* name) {
        const Reals given = array<Reals>(name);
        Matrix result(static_cast<int>(given.shape(0)), static_cast<int>(given.shape(1)));
        for (int i = 0; i < result.rows; ++i) std::copy_n(given.data() + i * given.shape(1), given.shape(1), result.at(i));
        return result;
    }

private:
    template <typename Given> Given array(const char* name) {
        Given found = feed_[name].cast<Given>();
        kept_.append(found);
        return found;
    }

    const py::dict& feed_;
    py::list kept_;
};

void read_scene(Feed& feed, Scene& scene, bool measured) {
    scene.intrinsics = feed.numbers("intrinsics"), scene.common = feed.numbers("common");
    scene.covariance = feed.numbers("covariance"), scene.estimate = feed.numbers("estimate");
    scene.poses = feed.numbers("poses"), scene.calibration = feed.numbers("calibration");
    scene.anchors = feed.numbers<Integers>("anchors"), scene.views = feed.numbers<Integers>("views");
    scene.pair = feed.numbers<Integers>("pair");
    scene.depth = feed.number("depth"), scene.unscented = feed.number("unscented");
    scene.pairs = feed.length("anchors"), scene.count = feed.length("pair");
    scene.state = CALIBRATION + 6 * feed.length("poses");
    scene.measurement = measured ? feed.numbers("measurement") : nullptr;
    scene.noise = measured ? feed.numbers("noise") : nullptr;
}

Frame read_frame(Feed& feed, bool measured) {
    Frame frame;
    read_scene(feed, frame, measured);
    frame.dependence = feed.numbers("dependence");
    // The compiled steps alone take them: what hundreds of landmarks depend on is not copied then.
    frame.rows = feed.has("rows") ? feed.numbers<Integers>("rows") : nullptr;
    frame.factor = feed.matrix("factor");
    return frame;
}

Window read_window(Feed& feed, double freedom) {
    Window window;
    read_scene(feed, window, true);
    window.owner = feed.numbers<Integers>("owner");
    window.spread = feed.numbers("spread");
    window.landmarks = feed.length("estimate");
    window.freedom = freedom;
    return window;
}

// A part of a matrix, from a column on.
Reals array(const Matrix& matrix, int rows, int columns, int first = 0) {
    Reals result({rows, columns});
    for (int i = 0; i < rows; ++i) std::copy_n(matrix.at(i) + first, columns, result.mutable_data() + i * columns);
    return result;
}

Reals array(const std::vector<double>& values, std::vector<py::ssize_t> shape) {
    Reals result(shape);
    std::copy(values.begin(), values.end(), result.mutable_data());
    return result;
}

Reals column(const Matrix& matrix, int rows, int place) { return array(matrix, rows, 1, place).reshape({rows}); }

py::list frame_predict(const py::dict& given) {
    Feed feed(given);
    const Frame frame = read_frame(feed, false);
    Reals mean({frame.count, 3}), covariance({frame.count, 3, 3});
    py::array_t<bool> in_front(frame.count);
    double *to_mean = mean.mutable_data(), *to_covariance = covariance.mutable_data();
    bool* to_front = in_front.mutable_data();
    {
        py::gil_scoped_release release;
        Matrix identity(frame.factor.width, frame.factor.width);
        for (int i = 0; i < identity.rows; ++i) identity.at(i)[i] = 1.0;
        std::vector<double> spread(frame.state * frame.state);
        const Matrix product = HAS_AVX2 ? wide::outer(frame.factor, identity) : plain::outer(frame.factor, identity);
        for (int i = 0; i < frame.state; ++i) std::copy_n(product.at(i), frame.state, &spread[i * frame.state]);
        (HAS_AVX2 ? wide::predict_views : plain::predict_views)(frame, spread.data(), to_mean, to_covariance, to_front);
    }
    py::list results;
    results.append(mean), results.append(covariance), results.append(in_front);
    return results;
}

py::list frame_robust(const py::dict& given) {
    Feed feed(given);
    const Frame frame = read_frame(feed, true);
    const double *offset = feed.numbers("offset"), *spread = feed.numbers("spread"), *moved = feed.numbers("moved");
    const bool gated = feed.number("gated") > 0.0;
    const double scale = feed.number("scale");
    Step step;
    {
        py::gil_scoped_release release;
        step = (HAS_AVX2 ? wide::robust_step : plain::robust_step)(frame, offset, spread, moved, gated, scale);
    }
    py::list results;
    results.append(column(step.offset, frame.state, 0));
    results.append(array(step.spread, frame.state, frame.state));
    results.append(array(step.moved, {frame.count, 6}));
    results.append(array({step.usable}, {}));
    return results;
}

py::list frame_gated(const py::dict& given) {
    Feed feed(given);
    const Frame frame = read_frame(feed, true);
    const double *offset = feed.numbers("offset"), *spread = feed.numbers("spread"), *moved = feed.numbers("moved");
    const double noise_scale = feed.number("noise_scale"), scale = feed.number("scale");
    const double freedom = feed.number("freedom");
    const Matrix prior = feed.matrix("prior");
    const int columns = feed.length("prior", 1);
    // The compiled step alone takes those of the step before: where they are the same the rest is not computed.
    const bool* inliers = feed.has("inliers") ? feed.numbers<Flags>("inliers") : nullptr;
    Step step;
    {
        py::gil_scoped_release release;
        step = (HAS_AVX2 ? wide::gated_step : plain::gated_step)(frame, offset, spread, moved, noise_scale, scale,
                                                                 freedom, prior, inliers);
    }
    py::array_t<bool> agree(frame.count);
    std::copy(step.agree.begin(), step.agree.end(), agree.mutable_data());
    py::list results;
    results.append(agree);
    results.append(array({step.count}, {}));
    results.append(array({step.usable}, {}));
    results.append(array(step.squared, {frame.count}));
    results.append(array({step.noise_scale}, {}));
    if (step.scores.empty()) return results;
    results.append(column(step.offset, frame.state, 0));
    results.append(array(step.spread, frame.state, frame.state));
    results.append(array(step.moved, {frame.count, 6}));
    results.append(array(step.common, frame.state, columns));
    results.append(array(step.information, frame.state, frame.state));
    results.append(array(step.scores, {frame.count, 6}));
    results.append(array(std::vector<double>(step.score.begin(), step.score.begin() + frame.state), {frame.state}));
    results.append(array({step.prior_cost}, {}));
    return results;
}

py::list window_eliminate(const py::dict& given) {
    Feed feed(given);
    const Window window = read_window(feed, feed.number("freedom"));
    const double *measured = feed.numbers("measured"), *variance = feed.numbers("variance");
    Equations found;
    {
        py::gil_scoped_release release;
        found = (HAS_AVX2 ? wide::eliminate : plain::eliminate)(window, measured, variance);
        for (int i = 0; i < 6 * window.landmarks; ++i)
            for (int j = 0; j < window.state; ++j) found.solved.at(i)[j] = -found.solved.at(i)[j];
    }
    const int size = window.state, count = window.landmarks;
    py::list results;
    results.append(array(found.information, size, size));
    results.append(column(found.information, size, size));
    results.append(array(found.own, {count, 6, 6}));
    results.append(array(found.solved, 6 * count, size).reshape({count, 6, size}));
    results.append(array(found.solved, 6 * count, 1, size).reshape({count, 6}));
    return results;
}

py::list window_gate(const py::dict& given) {
    Feed feed(given);
    const Window window = read_window(feed, 1.0);  // the degrees of freedom do not matter to the gate
    py::array_t<bool> agree(window.count);
    bool* to = agree.mutable_data();
    {
        py::gil_scoped_release release;
        (HAS_AVX2 ? wide::window_views : plain::window_views)(window, to, nullptr);
    }
    py::list results;
    results.append(agree);
    return results;
}

py::list pose_predict(const py::dict& given) {
    Feed feed(given);
    double motion[7 + 16], covariance[MOTION][MOTION];
    std::copy_n(feed.numbers("twist"), 6, std::copy_n(feed.numbers("pose"), 16, motion));
    motion[22] = feed.number("step");
    std::copy_n(feed.numbers("covariance"), MOTION * MOTION, covariance[0]);
    Reals pose({4, 4}), spread({MOTION, MOTION});
    (HAS_AVX2 ? wide::predict_motion : plain::predict_motion)(motion, covariance, feed.numbers("densities"),
                                                              pose.mutable_data(), spread.mutable_data());
    py::list results;
    results.append(pose), results.append(spread);
    return results;
}

py::list inertial_predict(const py::dict& given) {
    Feed feed(given);
    std::vector<double> motion(279 + 81 + 2);
    double* to = motion.data();
    const std::initializer_list<std::pair<const char*, int>> parts = {
        {"pose", 16}, {"velocity", 3},        {"gravity", 3},         {"mounting", 16}, {"seconds", 1}, {"turn", 9},
        {"velocity_change", 3}, {"position_change", 3}, {"slope", 225}, {"noise", 81},    {"walk", 2}};
    for (const auto& [name, count] : parts) to = std::copy_n(feed.numbers(name), count, to);
    const Matrix root = feed.matrix("root");
    Matrix spread(root.width, root.width), carried = spread;
    Reals pose({4, 4}), velocity(3);
    (HAS_AVX2 ? wide::predict_sensed : plain::predict_sensed)(motion.data(), root, pose.mutable_data(),
                                                              velocity.mutable_data(), spread, carried);
    py::list results;
    results.append(pose), results.append(velocity);
    results.append(array(spread, SENSED, SENSED)), results.append(array(carried, SENSED, SENSED));
    return results;
}

py::list window_condition(const py::dict& given) {
    Feed feed(given);
    const Matrix factor = feed.matrix("factor"), information = feed.matrix("information"), common = feed.matrix("common");
    const int size = factor.rows, columns = feed.length("common", 1);
    const double* vector = feed.numbers("vector");
    Matrix learned(size, 1 + columns), moved = learned;
    for (int i = 0; i < size; ++i) {
        learned.at(i)[0] = vector[i];
        std::copy_n(common.at(i), columns, learned.at(i) + 1);
    }
    const Matrix covariance = (HAS_AVX2 ? wide::condition : plain::condition)(factor, information, learned, moved);
    for (int i = 0; i < size; ++i)
        for (int j = 0; j < columns; ++j) moved.at(i)[1 + j] += common.at(i)[j];
    py::list results;
    results.append(column(moved, size, 0));
    results.append(array(covariance, size, size));
    results.append(array(moved, size, columns, 1));
    return results;
}

}  // namespace

PYBIND11_MODULE(_estimator, module) {
    module.doc() = "The estimator's graphs, compiled; sigmaslam.estimation.estimator_graphs chooses.";
    // Four numbers at once without registers for them: GCC's code takes longer than the graphs, Clang's half as long.
#if defined(__clang__)
    module.attr("FAST") = true;
#else
    module.attr("FAST") = HAS_AVX2;
#endif
    module.def("frame_predict", &frame_predict);
    module.def("frame_robust", &frame_robust);
    module.def("frame_gated", &frame_gated);
    module.def("pose_predict", &pose_predict);
    module.def("inertial_predict", &inertial_predict);
    module.def("window_condition", &window_condition);
    module.def("window_eliminate", &window_eliminate);
    module.def("window_gate", &window_gate);
}
