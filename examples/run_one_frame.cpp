// One frame by the graphs that ship, in C++ and ONNX Runtime's C API alone: run_one_frame.py in another language.
//
//     g++ -std=c++17 -O2 -I INCLUDE run_one_frame.cpp -o run_one_frame LIBRARY    (LIBRARY: libonnxruntime.so)
//     ./run_one_frame models/sigmaslam_weights FOLDER 4
//
// INCLUDE is the folder of onnxruntime_c_api.h, which releases of ONNX Runtime have; the wheel has the library alone.
// FOLDER has KITTI's layout, but images 0 and 4 of image_0 and image_1 as PGM (P5, 8 bits), which needs no library.
// Standard output: the pose T_0_4 (4 x 4, metres), then its covariance (6 x 6), perturbed from the left: translation,
// rotation; row by row. docs/onnx.md says what each graph takes.

#include <onnxruntime_c_api.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstring>
#include <fstream>
#include <iterator>
#include <map>
#include <memory>
#include <sstream>
#include <stdexcept>
#include <string>
#include <type_traits>
#include <utility>
#include <vector>

namespace {

constexpr std::int64_t KEYPOINTS = 400;
constexpr double FREEDOM = 2.0;  // of the Student-t that errors are taken for, as the tracker's
constexpr std::size_t CALIBRATION = 12, POSE = 6, STATE = CALIBRATION + 2 * POSE;

const OrtApi* const ort = OrtGetApiBase()->GetApi(ORT_API_VERSION);

void check(OrtStatus* status) {
    if (status == nullptr) return;
    const std::string message = ort->GetErrorMessage(status);
    ort->ReleaseStatus(status);
    throw std::runtime_error("ONNX Runtime: " + message);
}

template <typename T>
constexpr ONNXTensorElementDataType element_type() {
    if constexpr (std::is_same_v<T, float>) return ONNX_TENSOR_ELEMENT_DATA_TYPE_FLOAT;
    if constexpr (std::is_same_v<T, double>) return ONNX_TENSOR_ELEMENT_DATA_TYPE_DOUBLE;
    return ONNX_TENSOR_ELEMENT_DATA_TYPE_INT64;
}

// A tensor of ONNX Runtime, and the memory behind it where it is ours.
class Tensor {
public:
    template <typename T>
    Tensor(std::vector<T> values, std::vector<std::int64_t> shape) {
        auto kept = std::make_shared<std::vector<T>>(std::move(values));
        OrtMemoryInfo* memory = nullptr;
        check(ort->CreateCpuMemoryInfo(OrtArenaAllocator, OrtMemTypeDefault, &memory));
        OrtValue* made = nullptr;
        OrtStatus* status = ort->CreateTensorWithDataAsOrtValue(memory, kept->data(), kept->size() * sizeof(T),
                                                                shape.data(), shape.size(), element_type<T>(), &made);
        ort->ReleaseMemoryInfo(memory);
        check(status);
        memory_ = kept;
        value_.reset(made, ort->ReleaseValue);
    }
    explicit Tensor(double value) : Tensor(std::vector<double>{value}, {}) {}
    explicit Tensor(OrtValue* taken) : value_(taken, ort->ReleaseValue) {}

    OrtValue* value() const { return value_.get(); }

    template <typename T>
    std::vector<T> values() const {
        OrtTensorTypeAndShapeInfo* described = nullptr;
        check(ort->GetTensorTypeAndShape(value(), &described));
        std::size_t count = 0;
        OrtStatus* status = ort->GetTensorShapeElementCount(described, &count);
        ort->ReleaseTensorTypeAndShapeInfo(described);
        check(status);
        void* data = nullptr;
        check(ort->GetTensorMutableData(value(), &data));
        return {static_cast<T*>(data), static_cast<T*>(data) + count};
    }

private:
    std::shared_ptr<void> memory_;
    std::shared_ptr<OrtValue> value_;
};

using Named = std::map<std::string, Tensor>;

// A graph of a folder, on the CPU.
class Graph {
public:
    Graph(OrtEnv* environment, const std::string& path) {
        OrtSessionOptions* options = nullptr;
        check(ort->CreateSessionOptions(&options));
        // The tracker's: the graph's float64 products lose digits by this fusion.
        check(ort->AddSessionConfigEntry(options, "optimization.disable_specified_optimizers", "MatMulScaleFusion"));
        OrtSession* session = nullptr;
        OrtStatus* status = ort->CreateSession(environment, path.c_str(), options, &session);
        ort->ReleaseSessionOptions(options);
        check(status);
        session_.reset(session, ort->ReleaseSession);
        std::size_t count = 0;
        check(ort->SessionGetOutputCount(session, &count));
        for (std::size_t k = 0; k < count; ++k) {
            OrtAllocator* allocator = nullptr;
            check(ort->GetAllocatorWithDefaultOptions(&allocator));
            char* name = nullptr;
            check(ort->SessionGetOutputName(session, k, allocator, &name));
            outputs_.emplace_back(name);
            check(ort->AllocatorFree(allocator, name));
        }
    }

    Named operator()(const Named& given) const {
        std::vector<const char*> names, wanted;
        std::vector<const OrtValue*> values;
        for (const auto& [name, tensor] : given) {
            names.push_back(name.c_str());
            values.push_back(tensor.value());
        }
        for (const auto& name : outputs_) wanted.push_back(name.c_str());
        std::vector<OrtValue*> found(wanted.size(), nullptr);
        check(ort->Run(session_.get(), nullptr, names.data(), values.data(), names.size(), wanted.data(), wanted.size(),
                       found.data()));
        Named result;
        for (std::size_t k = 0; k < found.size(); ++k) result.emplace(outputs_[k], Tensor(found[k]));
        return result;
    }

private:
    std::shared_ptr<OrtSession> session_;
    std::vector<std::string> outputs_;
};

struct Image {
    std::size_t width, height;
    std::vector<std::uint8_t> pixels;
};

Image read_pgm(const std::string& path) {
    std::ifstream file(path, std::ios::binary);
    std::string kind;
    std::size_t width = 0, height = 0, most = 0;
    file >> kind >> width >> height >> most;
    file.get();
    Image image{width, height, std::vector<std::uint8_t>(width * height)};
    file.read(reinterpret_cast<char*>(image.pixels.data()), static_cast<std::streamsize>(image.pixels.size()));
    if (!file || kind != "P5" || most != 255) throw std::runtime_error(path + " is no PGM (P5) of 8 bits: convert it");
    return image;
}

std::vector<double> read_numbers(const std::string& text) {
    std::istringstream stream(text);
    return {std::istream_iterator<double>(stream), {}};
}

struct Features {
    std::vector<std::array<float, 2>> keypoints;  // pixels
    std::vector<std::vector<float>> descriptors;  // unit vectors
    std::vector<float> sigma;                     // pixels
};

Features detect(const Graph& features, const std::string& path) {
    const Image image = read_pgm(path);
    const std::size_t width = (image.width + 31) / 32 * 32, height = (image.height + 31) / 32 * 32;
    std::vector<float> padded(width * height);
    for (std::size_t v = 0; v < height; ++v) {
        for (std::size_t u = 0; u < width; ++u) {
            const std::size_t row = std::min(v, image.height - 1), column = std::min(u, image.width - 1);
            padded[v * width + u] = static_cast<float>(image.pixels[row * image.width + column]) / 255.0F;
        }
    }
    const std::vector<std::int64_t> shape{1, 1, static_cast<std::int64_t>(height), static_cast<std::int64_t>(width)};
    const Named found = features({{"image", Tensor(std::move(padded), shape)},
                                  {"count", Tensor(std::vector<std::int64_t>{KEYPOINTS}, {})}});
    const auto keypoints = found.at("keypoints").values<float>(), scores = found.at("scores").values<float>();
    const auto descriptors = found.at("descriptors").values<float>(), sigma = found.at("sigma").values<float>();
    const std::size_t length = descriptors.size() / scores.size();
    Features kept;
    for (std::size_t k = 0; k < scores.size(); ++k) {
        const float u = keypoints[2 * k], v = keypoints[2 * k + 1];
        const bool inside = u < static_cast<float>(image.width) && v < static_cast<float>(image.height);
        if (!(scores[k] > 0.0F && inside)) continue;
        kept.keypoints.push_back({u, v});
        kept.descriptors.emplace_back(&descriptors[k * length], &descriptors[k * length] + length);
        kept.sigma.push_back(sigma[k]);
    }
    return kept;
}

// Pairs of rows that are each other's most similar among the allowed ones.
template <typename Allowed>
std::vector<std::pair<std::size_t, std::size_t>> match(const std::vector<std::vector<float>>& first,
                                                       const std::vector<std::vector<float>>& second, Allowed allowed) {
    std::vector<std::vector<float>> similarity(first.size(), std::vector<float>(second.size(), -1.0F));
    std::vector<std::size_t> best_row(second.size(), 0);
    for (std::size_t i = 0; i < first.size(); ++i) {
        for (std::size_t j = 0; j < second.size(); ++j) {
            if (!allowed(i, j)) continue;
            float sum = 0.0F;
            for (std::size_t c = 0; c < first[i].size(); ++c) sum += first[i][c] * second[j][c];
            similarity[i][j] = sum;
            if (sum > similarity[best_row[j]][j]) best_row[j] = i;
        }
    }
    std::vector<std::pair<std::size_t, std::size_t>> pairs;
    for (std::size_t i = 0; i < first.size(); ++i) {
        const auto best = std::max_element(similarity[i].begin(), similarity[i].end());
        const auto j = static_cast<std::size_t>(best - similarity[i].begin());
        if (*best > 0.5F && best_row[j] == i) pairs.emplace_back(i, j);
    }
    return pairs;
}

struct StereoPoints {
    std::vector<std::array<double, 3>> measured;    // u, v, disparity
    std::vector<std::array<double, 9>> covariance;  // pixels squared
    std::vector<std::vector<float>> descriptors;
};

StereoPoints stereo(const Graph& features, const std::string& folder, int index) {
    std::array<char, 16> name{};
    std::snprintf(name.data(), name.size(), "/%06d.pgm", index);
    const Features left = detect(features, folder + "/image_0" + name.data());
    const Features right = detect(features, folder + "/image_1" + name.data());
    const auto in_row = [&](std::size_t i, std::size_t j) {
        return std::abs(left.keypoints[i][1] - right.keypoints[j][1]) < 2.0F &&
               left.keypoints[i][0] - right.keypoints[j][0] > 0.5F;
    };
    StereoPoints points;
    for (const auto& [i, j] : match(left.descriptors, right.descriptors, in_row)) {
        const float disparity = left.keypoints[i][0] - right.keypoints[j][0];
        const float u = left.sigma[i] * left.sigma[i], both = u + right.sigma[j] * right.sigma[j];
        points.measured.push_back({left.keypoints[i][0], left.keypoints[i][1], disparity});
        points.covariance.push_back({u, 0, u, 0, u, 0, u, 0, both});
        points.descriptors.push_back(left.descriptors[i]);
    }
    return points;
}

using Matrix4 = std::array<double, 16>;

Matrix4 product(const Matrix4& a, const Matrix4& b) {
    Matrix4 c{};
    for (std::size_t i = 0; i < 4; ++i)
        for (std::size_t j = 0; j < 4; ++j)
            for (std::size_t k = 0; k < 4; ++k) c[4 * i + j] += a[4 * i + k] * b[4 * k + j];
    return c;
}

// Rigid motion of a twist: translation, rotation.
Matrix4 exponential(const double* twist) {
    const double x = twist[3], y = twist[4], z = twist[5];
    const Matrix4 matrix{0, -z, y, twist[0], z, 0, -x, twist[1], -y, x, 0, twist[2], 0, 0, 0, 0};
    Matrix4 term{1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1}, total = term;
    for (int k = 1; k < 20; ++k) {
        term = product(term, matrix);
        for (std::size_t i = 0; i < 16; ++i) {
            term[i] /= k;
            total[i] += term[i];
        }
    }
    return total;
}

// Lower triangular factor of the upper left block of a symmetric matrix of so many columns.
std::array<double, POSE * POSE> cholesky(const std::vector<double>& matrix, std::size_t columns) {
    std::array<double, POSE * POSE> factor{};
    for (std::size_t i = 0; i < POSE; ++i) {
        for (std::size_t j = 0; j <= i; ++j) {
            double sum = matrix[i * columns + j];
            for (std::size_t k = 0; k < j; ++k) sum -= factor[POSE * i + k] * factor[POSE * j + k];
            factor[POSE * i + j] = i == j ? std::sqrt(sum) : sum / factor[POSE * j + j];
        }
    }
    return factor;
}

Tensor zeros(std::vector<std::int64_t> shape) {
    std::size_t count = 1;
    for (const auto length : shape) count *= static_cast<std::size_t>(length);
    return {std::vector<double>(count, 0.0), std::move(shape)};
}

// Rows of a matrix of `length` columns, one for each of `chosen`.
template <typename Rows, typename Choose>
Tensor gather(const Rows& rows, std::size_t count, Choose chosen, std::vector<std::int64_t> shape) {
    std::vector<double> values;
    for (std::size_t k = 0; k < count; ++k) {
        const auto& row = rows[chosen(k)];
        values.insert(values.end(), row.begin(), row.end());
    }
    return {std::move(values), std::move(shape)};
}

void run(OrtEnv* environment, const std::string& weights, const std::string& folder, int index) {
    const Graph features(environment, weights + "/features.onnx"), predict(environment, weights + "/pose_predict.onnx");
    const Graph robust(environment, weights + "/frame_robust.onnx"), gated(environment, weights + "/frame_gated.onnx");
    std::ifstream calibration_file(folder + "/calib.txt"), times_file(folder + "/times.txt");
    std::array<std::vector<double>, 2> P;
    for (auto& row : P) {
        std::string line;
        std::getline(calibration_file, line);
        row = read_numbers(line.substr(std::min(line.size(), line.find(' '))));
        if (row.size() != 12) throw std::runtime_error(folder + "/calib.txt: P0 or P1 has no 12 numbers: write them");
    }
    const std::vector<double> intrinsics{P[0][0], P[0][5], P[0][2], P[0][6], P[0][3] - P[1][3]};
    const std::vector<double> times{std::istream_iterator<double>(times_file), {}};

    // Predict: at rest in the first image, of a speed that is known to 0.5 m/s and 0.5 rad/s.
    std::vector<double> prior(12 * 12, 0.0);
    for (std::size_t k = 0; k < 12; ++k) prior[13 * k] = k < POSE ? 1e-12 : 0.25;
    const Matrix4 identity{1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1};
    const std::vector<double> here(identity.begin(), identity.end());
    const Named predicted = predict({{"pose", Tensor(here, {4, 4})},
                                     {"twist", zeros({6})},
                                     {"covariance", Tensor(prior, {12, 12})},
                                     {"densities", Tensor(std::vector<double>{0.1, 0.1}, {2})},
                                     {"step", Tensor(times.at(static_cast<std::size_t>(index)) - times.at(0))}});
    const auto pose = predicted.at("predicted_pose").values<double>();
    const auto root = cholesky(predicted.at("predicted_covariance").values<double>(), 12);

    // Measure: landmarks of the first pair, found again in the second.
    const StereoPoints hosted = stereo(features, folder, 0), seen = stereo(features, folder, index);
    const auto pairs = match(hosted.descriptors, seen.descriptors, [&](std::size_t i, std::size_t j) {
        const double du = hosted.measured[i][0] - seen.measured[j][0], dv = hosted.measured[i][1] - seen.measured[j][1];
        return std::sqrt(du * du + dv * dv) < 60.0;
    });
    const std::size_t size = pairs.size();
    if (size == 0) throw std::runtime_error("nothing of the first pair is found in the second: give a smaller index");
    const auto count = static_cast<std::int64_t>(size), state = static_cast<std::int64_t>(STATE);
    std::vector<double> covariance(size * 36, 0.0), estimate(size * 6, 0.0), depths;
    for (std::size_t k = 0; k < size; ++k) {
        const std::size_t row = pairs[k].first;
        depths.push_back(intrinsics[4] / hosted.measured[row][2]);
        for (std::size_t i = 0; i < 3; ++i) {
            estimate[6 * k + i] = hosted.measured[row][i];
            for (std::size_t j = 0; j < 3; ++j) covariance[36 * k + 6 * i + j] = hosted.covariance[row][3 * i + j];
        }
    }
    std::sort(depths.begin(), depths.end());
    const double depth = 0.5 * (depths[(size - 1) / 2] + depths[size / 2]);

    // Update: the state is 12 errors of the calibration and the first pose, which are known here, and the frame's pose.
    std::vector<double> factor(STATE * POSE, 0.0), spread(STATE * STATE, 0.0), poses = here;
    std::copy(root.begin(), root.end(), factor.end() - static_cast<std::ptrdiff_t>(root.size()));
    for (std::size_t i = 0; i < STATE; ++i)
        for (std::size_t j = 0; j < STATE; ++j)
            for (std::size_t k = 0; k < POSE; ++k) spread[STATE * i + j] += factor[POSE * i + k] * factor[POSE * j + k];
    poses.insert(poses.end(), pose.begin(), pose.end());
    const auto other = [&](std::size_t k) { return pairs[k].second; };
    Named given{{"intrinsics", Tensor(intrinsics, {5})},
                {"depth", Tensor(depth)},
                {"unscented", Tensor(1.0)},
                {"anchors", Tensor(std::vector<std::int64_t>{0}, {1})},
                {"views", Tensor(std::vector<std::int64_t>{1}, {1})},
                {"pair", Tensor(std::vector<std::int64_t>(size, 0), {count})},
                {"common", zeros({count, 3, 2})},
                {"covariance", Tensor(covariance, {count, 6, 6})},
                {"estimate", Tensor(estimate, {count, 6})},
                {"dependence", zeros({count, 6, state})},
                {"poses", Tensor(poses, {2, 4, 4})},
                {"calibration", zeros({12})},
                {"factor", Tensor(factor, {state, 6})},
                {"measurement", gather(seen.measured, size, other, {count, 3})},
                {"noise", gather(seen.covariance, size, other, {count, 3, 3})},
                {"scale", Tensor(1.0)},
                {"offset", zeros({state})},
                {"spread", Tensor(spread, {state, state})},
                {"moved", zeros({count, 6})}};
    const auto take = [&](const Named& found) {
        for (const std::string name : {"offset", "spread", "moved"}) {
            given.insert_or_assign(name, found.at(name + "_after"));
        }
    };
    for (const double first : {1.0, 0.0}) {
        given.insert_or_assign("gated", Tensor(first));
        take(robust(given));
    }
    given.erase("gated");
    given.insert_or_assign("noise_scale", Tensor(0.0));
    given.insert_or_assign("freedom", Tensor(FREEDOM));
    given.insert_or_assign("prior", zeros({state, 12}));
    double agreeing = 0.0;
    for (int k = 0; k < 2; ++k) {
        const Named found = gated(given);
        take(found);
        given.insert_or_assign("noise_scale", found.at("noise_scale_found"));
        agreeing = found.at("count").values<double>()[0];
    }
    std::fprintf(stderr, "%zu landmarks, %.0f of them agree\n", size, agreeing);

    const auto offset = given.at("offset").values<double>(), after = given.at("spread").values<double>();
    Matrix4 prediction{};
    std::copy(pose.begin(), pose.end(), prediction.begin());
    const Matrix4 found = product(exponential(&offset[STATE - POSE]), prediction);
    for (std::size_t k = 0; k < 16; ++k) std::printf("%.17g%c", found[k], k % 4 == 3 ? '\n' : ' ');
    for (std::size_t i = STATE - POSE; i < STATE; ++i)
        for (std::size_t j = STATE - POSE; j < STATE; ++j)
            std::printf("%.17g%c", after[STATE * i + j], j + 1 == STATE ? '\n' : ' ');
}

}  // namespace

int main(int count, char** words) {
    if (count != 4) {
        std::fprintf(stderr, "usage: run_one_frame WEIGHTS FOLDER INDEX\n");
        return 2;
    }
    if (ort == nullptr) {
        std::fprintf(stderr, "error: the library is older than the header: take those of one version\n");
        return 2;
    }
    OrtEnv* environment = nullptr;
    try {
        check(ort->CreateEnv(ORT_LOGGING_LEVEL_ERROR, "run_one_frame", &environment));
        run(environment, words[1], words[2], std::stoi(words[3]));
    } catch (const std::exception& error) {
        std::fprintf(stderr, "error: %s\n", error.what());
        return 1;
    }
    ort->ReleaseEnv(environment);
    return 0;
}
