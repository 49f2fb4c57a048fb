// Run an exported graph in C++ with the ONNX Runtime C++ API:
//   infer MODEL TENSORS VIEWS HEIGHT WIDTH
// TENSORS is a folder that write_tensors.py wrote. Beside the inputs are written scene.ply, the Gaussians in the unit and
// frame of the cameras, and the outputs as raw float32 files.

#include <onnxruntime_cxx_api.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <exception>
#include <filesystem>
#include <fstream>
#include <iostream>
#include <stdexcept>
#include <string>
#include <vector>

namespace fs = std::filesystem;

static std::vector<float> read_floats(const fs::path& path, std::size_t count) {
  std::vector<float> values(count);
  std::ifstream file(path, std::ios::binary);
  if (!file.read(reinterpret_cast<char*>(values.data()), static_cast<std::streamsize>(count * sizeof(float)))) {
    throw std::runtime_error(path.string() + ": expected " + std::to_string(count) + " float32 values");
  }
  return values;
}

// The file that viewers of 3D Gaussian splats read: opacities as logits, scales as logarithms, SH coefficients of degree 0
// and then the others, all of red, of green and of blue. outputs: means [n, 3], scales [n, 3], quats [n, 4] (wxyz),
// opacities [n], sh [n, coefficients, 3]. frame: scale and origin of the network's frame.
static void write_ply(const fs::path& path, const std::vector<Ort::Value>& outputs, const std::vector<float>& frame) {
  std::array<const float*, 5> values;
  for (std::size_t i = 0; i < values.size(); ++i) values[i] = outputs[i + 1].GetTensorData<float>();  // after depth
  const auto [means, scales, quats, opacities, sh] = values;
  const std::vector<int64_t> shape = outputs[5].GetTensorTypeAndShapeInfo().GetShape();
  const int64_t count = shape[0], coefficients = shape[1];

  std::vector<std::string> names = {"x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"};
  for (int64_t i = 0; i < 3 * (coefficients - 1); ++i) names.push_back("f_rest_" + std::to_string(i));
  for (const char* name : {"opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"}) {
    names.push_back(name);
  }
  std::ofstream file(path, std::ios::binary);
  file << "ply\nformat binary_little_endian 1.0\nelement vertex " << count << '\n';
  for (const std::string& name : names) file << "property float " << name << '\n';
  file << "end_header\n";

  for (int64_t n = 0; n < count; ++n) {
    std::vector<float> row;
    for (int axis = 0; axis < 3; ++axis) row.push_back(means[3 * n + axis] / frame[0] + frame[1 + axis]);
    row.insert(row.end(), 3, 0);  // normals
    const float* own = sh + 3 * coefficients * n;
    row.insert(row.end(), own, own + 3);
    for (int channel = 0; channel < 3; ++channel) {
      for (int64_t k = 1; k < coefficients; ++k) row.push_back(own[3 * k + channel]);
    }
    const float opacity = std::clamp(opacities[n], 1e-6f, 1 - 1e-6f);
    row.push_back(std::log(opacity / (1 - opacity)));
    for (int axis = 0; axis < 3; ++axis) row.push_back(std::log(scales[3 * n + axis] / frame[0]));
    row.insert(row.end(), quats + 4 * n, quats + 4 * n + 4);
    file.write(reinterpret_cast<const char*>(row.data()), static_cast<std::streamsize>(row.size() * sizeof(float)));
  }
}

static void run(const fs::path& model, const fs::path& folder, int64_t views, int64_t height, int64_t width) {
  const std::vector<const char*> input_names = {"images", "extrinsics", "intrinsics", "near", "far"};
  const std::vector<std::vector<int64_t>> shapes = {
      {views, 3, height, width}, {views, 4, 4}, {views, 3, 3}, {views}, {views}};

  Ort::Env env(ORT_LOGGING_LEVEL_WARNING, "idesplat");
  Ort::SessionOptions options;
  options.AddConfigEntry("session.x64quantprecision", "1");  // int8 is wrong on some CPUs without it
  Ort::Session session(env, model.c_str(), options);

  const auto memory = Ort::MemoryInfo::CreateCpu(OrtArenaAllocator, OrtMemTypeDefault);
  std::vector<std::vector<float>> buffers;  // a tensor refers to its buffer and does not copy it
  std::vector<Ort::Value> inputs;
  for (std::size_t i = 0; i < shapes.size(); ++i) {
    int64_t count = 1;
    for (const int64_t side : shapes[i]) count *= side;
    buffers.push_back(read_floats(folder / (std::string(input_names[i]) + ".f32"), static_cast<std::size_t>(count)));
    inputs.push_back(Ort::Value::CreateTensor<float>(memory, buffers.back().data(), buffers.back().size(),
                                                     shapes[i].data(), shapes[i].size()));
  }

  const std::vector<const char*> output_names = {"depth", "means", "scales", "quats", "opacities", "sh"};
  const std::vector<Ort::Value> outputs = session.Run(Ort::RunOptions{nullptr}, input_names.data(), inputs.data(),
                                                      inputs.size(), output_names.data(), output_names.size());
  for (std::size_t i = 0; i < outputs.size(); ++i) {
    const auto info = outputs[i].GetTensorTypeAndShapeInfo();
    std::ofstream file(folder / (std::string(output_names[i]) + ".f32"), std::ios::binary);
    file.write(reinterpret_cast<const char*>(outputs[i].GetTensorData<float>()),
               static_cast<std::streamsize>(info.GetElementCount() * sizeof(float)));
    std::cout << output_names[i];
    for (const int64_t side : info.GetShape()) std::cout << ' ' << side;
    std::cout << '\n';
  }
  write_ply(folder / "scene.ply", outputs, read_floats(folder / "frame.f32", 4));
}

int main(int argc, char** argv) {
  if (argc != 6) {
    std::cerr << "usage: infer MODEL TENSORS VIEWS HEIGHT WIDTH\n";
    return 2;
  }
  try {
    run(argv[1], argv[2], std::stoll(argv[3]), std::stoll(argv[4]), std::stoll(argv[5]));
  } catch (const std::exception& error) {
    std::cerr << "error: " << error.what() << '\n';
    return 1;
  }
}
