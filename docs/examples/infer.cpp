// Run an exported graph in C++ with the ONNX Runtime C++ API:
//   infer MODEL TENSORS VIEWS HEIGHT WIDTH
// TENSORS is a folder that write_tensors.py wrote; the outputs are written beside the inputs, as raw float32 files.

#include <onnxruntime_cxx_api.h>

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

static void run(const fs::path& model, const fs::path& folder, int64_t views, int64_t height, int64_t width) {
  const std::vector<const char*> input_names = {"images", "extrinsics", "intrinsics", "near", "far"};
  const std::vector<std::vector<int64_t>> shapes = {
      {views, 3, height, width}, {views, 4, 4}, {views, 3, 3}, {views}, {views}};

  Ort::Env env(ORT_LOGGING_LEVEL_WARNING, "idesplat");
  Ort::SessionOptions options;
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
