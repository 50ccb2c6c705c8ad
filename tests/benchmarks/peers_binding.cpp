// Lets Python call the CPU rasterizer of an OpenSplat checkout: tests/benchmarks/peers.py compiles this with it.
#include <torch/extension.h>

#include <vector>

#include "project_gaussians.hpp"
#include "rasterize_gaussians.hpp"
#include "spherical_harmonics.hpp"

namespace {

// (H, W, 3) image, differentiable. `calibration` is fx, fy, cx, cy. With `sort_by_depth` the depths are handed over
// in the memory layout that the rasterizer reads, which is not the one that the projection returns.
torch::Tensor draw(
    const torch::Tensor& means,
    const torch::Tensor& quaternions,
    const torch::Tensor& log_scales,
    const torch::Tensor& opacity_logits,
    const torch::Tensor& sh,
    const torch::Tensor& cam_from_world,
    const torch::Tensor& clip_from_world,
    const torch::Tensor& centre,
    const torch::Tensor& background,
    const std::vector<double>& calibration,
    int64_t width,
    int64_t height,
    bool sort_by_depth) {
  const auto unit = quaternions / quaternions.norm(2, {-1}, true);
  auto projected = ProjectGaussiansCPU::apply(
      means, log_scales.exp(), 1.0f, unit, cam_from_world, clip_from_world,
      static_cast<float>(calibration[0]), static_cast<float>(calibration[1]),
      static_cast<float>(calibration[2]), static_cast<float>(calibration[3]),
      static_cast<int>(height), static_cast<int>(width));
  const auto depths = sort_by_depth ? projected[4].contiguous() : projected[4];
  auto directions = means.detach() - centre;
  directions = directions / directions.norm(2, {-1}, true);
  const auto harmonics = SphericalHarmonicsCPU::apply(degFromSh(static_cast<int>(sh.size(1))), directions, sh);
  const auto colours = torch::clamp_min(harmonics + 0.5f, 0.0f);
  return RasterizeGaussiansCPU::apply(
      projected[0], projected[1], projected[2], colours, opacity_logits.sigmoid(), projected[3], depths,
      static_cast<int>(height), static_cast<int>(width), background);
}

}  // namespace

PYBIND11_MODULE(TORCH_EXTENSION_NAME, module) { module.def("draw", &draw); }
