// Bindings of sparse voxel grids; methods/plenoxels is their only caller.
#include "arrays.h"

#include <nanobind/stl/unique_ptr.h>
#include <nanobind/stl/vector.h>

#include <cmath>
#include <memory>
#include <vector>

#include "voxels.h"

namespace econgs {
namespace {

using Links = nb::ndarray<const int32_t, nb::ndim<3>, nb::c_contig, nb::device::cpu>;
using Bricks = nb::ndarray<const uint8_t, nb::ndim<3>, nb::c_contig, nb::device::cpu>;
using Doubles = nb::ndarray<const double, nb::c_contig, nb::device::cpu>;

template <class A>
int64_t voxels(const A& densities, const A& rows) {
  const int64_t n = densities.ndim() == 1 ? static_cast<int64_t>(densities.shape(0)) : -1;
  expect(n >= 0 && is(rows, {n, VOXEL_ROW}), "densities and rows must have shapes (N,) and (N, 32)");
  return n;
}

VoxelArrays written(const Array& densities, const Array& rows, int64_t count) {
  expect(voxels(densities, rows) == count, "gradients or moments of another number of voxels");
  return {densities.data(), rows.data()};
}

// Links are not looked through at every call: a grid makes them for its voxels and never changes them.
VoxelGrid grid_of(const Links& links, const In& densities, const In& rows) {
  voxels(densities, rows);
  VoxelGrid grid = {};
  grid.links = links.data();
  grid.densities = densities.data();
  grid.rows = rows.data();
  for (int i = 0; i < 3; ++i) {
    expect(links.shape(i) >= 2 && links.shape(i) <= 4096, "a grid has 2 to 4096 vertices along each side");
    grid.size[i] = static_cast<int>(links.shape(2 - i));
  }
  return grid;
}

// placement: origin (3), vertices per unit of length, optical depth of a step at density 1.
VoxelGrid placed(const Links& links, const In& densities, const In& rows, const Bricks& bricks,
                 const double* placement) {
  VoxelGrid grid = grid_of(links, densities, rows);
  grid.bricks = bricks.data();
  for (int i = 0; i < 3; ++i) {
    grid.bricks_across[i] = (grid.size[i] - 1 + VOXEL_BRICK - 1) / VOXEL_BRICK;
    expect(static_cast<int>(bricks.shape(2 - i)) == grid.bricks_across[i], "bricks of another grid");
    grid.origin[i] = placement[i];
  }
  grid.inverse = placement[3];
  grid.depth = static_cast<float>(placement[4]);
  expect(std::isfinite(grid.inverse) && grid.inverse > 0 && grid.depth >= 0, "the spacing must be positive");
  return grid;
}

VoxelGrid only(const Links& links, const In& densities, const In& rows, const Bricks& bricks,
               const Doubles& placement) {
  expect(is(placement, {5}), "the placement must have shape (5,)");
  return placed(links, densities, rows, bricks, placement.data());
}

std::vector<VoxelGrid> all_placed(const std::vector<Links>& links, const std::vector<In>& densities,
                                  const std::vector<In>& rows, const std::vector<Bricks>& bricks,
                                  const Doubles& placements) {
  const size_t count = links.size();
  expect(
      count >= 1 && count <= MAX_GRIDS && densities.size() == count && rows.size() == count && bricks.size() == count,
      "1 to 64 grids are drawn together, each with links, densities, rows and bricks");
  expect(is(placements, {static_cast<int64_t>(count), 5}), "placements must have shape (grids, 5)");
  std::vector<VoxelGrid> grids;
  for (size_t g = 0; g < count; ++g) {
    const VoxelGrid grid = placed(links[g], densities[g], rows[g], bricks[g], placements.data() + 5 * g);
    if (rows[g].shape(0) > 0) grids.push_back(grid);  // one without voxels shows nothing
  }
  return grids;
}

RayBatch rays_of(const In& origins, const In& directions, const In& near) {
  const int64_t n = near.ndim() == 1 ? static_cast<int64_t>(near.shape(0)) : -1;
  expect(n >= 0 && is(origins, {n, 3}) && is(directions, {n, 3}), "rays must have shapes (N, 3), (N, 3) and (N,)");
  return {origins.data(), directions.data(), near.data(), n};
}

void expect_step(double step) { expect(std::isfinite(step) && step > 0, "the step must be positive"); }

std::unique_ptr<MarchFrame> march_checked(const std::vector<Links>& links, const std::vector<In>& densities,
                                          const std::vector<In>& rows, const std::vector<Bricks>& bricks,
                                          const Doubles& placements, double step, const In& origins,
                                          const In& directions, const In& near, const Array& colors, const Array& alpha,
                                          bool keep) {
  const std::vector<VoxelGrid> grids = all_placed(links, densities, rows, bricks, placements);
  const RayBatch rays = rays_of(origins, directions, near);
  expect(is(colors, {rays.count, 3}) && is(alpha, {rays.count}), "outputs of another size than the rays");
  expect(!keep || links.size() == 1, "gradients are those of one grid");
  expect_step(step);
  float *const to_colors = colors.data(), *const to_alpha = alpha.data();
  nb::gil_scoped_release release;
  return march({grids.data(), static_cast<int>(grids.size()), step}, rays, to_colors, to_alpha, keep);
}

void march_backward_checked(const MarchFrame& frame, const Links& links, const In& densities, const In& rows,
                            const Bricks& bricks, const Doubles& placement, const In& grad_colors, const In& grad_alpha,
                            const Array& to_densities, const Array& to_rows) {
  const VoxelGrid grid = only(links, densities, rows, bricks, placement);
  expect(is(grad_colors, {frame.count, 3}) && is(grad_alpha, {frame.count}), "gradients of another size");
  expect(static_cast<int64_t>(frame.samples.size()) == frame.count, "the frame was not kept");
  const VoxelArrays to = written(to_densities, to_rows, densities.shape(0));
  const float *const color = grad_colors.data(), *const alpha = grad_alpha.data();
  nb::gil_scoped_release release;
  march_backward(frame, grid, color, alpha, to);
}

void weights_checked(const Links& links, const In& densities, const In& rows, const Bricks& bricks,
                     const Doubles& placement, double step, const In& origins, const In& directions, const In& near,
                     const Array& most) {
  const VoxelGrid grid = only(links, densities, rows, bricks, placement);
  const RayBatch rays = rays_of(origins, directions, near);
  const int64_t n = densities.shape(0);
  expect(is(most, {n}), "one weight for each voxel is needed");
  expect_step(step);
  float* const to = most.data();
  nb::gil_scoped_release release;
  if (n > 0) voxel_weights({&grid, 1, step}, rays, n, to);
}

double variation_checked(const Links& links, const In& densities, const In& rows, int64_t begin, int64_t count,
                         const In& factors, float spread, const Array& to_densities, const Array& to_rows) {
  const VoxelGrid grid = grid_of(links, densities, rows);
  const VoxelArrays to = written(to_densities, to_rows, densities.shape(0));
  const int64_t total = static_cast<int64_t>(links.size());
  expect(is(factors, {2}), "a factor of densities and one of coefficients are needed");
  expect(begin >= 0 && begin < total && count >= 0 && count <= total, "vertices beyond the grid");
  const float* const each = factors.data();
  nb::gil_scoped_release release;
  return variation(grid, begin, count, each, spread, to);
}

void step_checked(const Array& densities, const Array& rows, const Array& grad_densities, const Array& grad_rows,
                  const Array& moment_densities, const Array& moment_rows, const In& rates, float beta, float eps) {
  const int64_t n = voxels(densities, rows);
  const VoxelArrays values = written(densities, rows, n), grads = written(grad_densities, grad_rows, n),
                    moments = written(moment_densities, moment_rows, n);
  expect(is(rates, {2}), "a rate of densities and one of coefficients are needed");
  const float* const each = rates.data();
  nb::gil_scoped_release release;
  rms_step(values, grads, moments, n, each, beta, eps);
}

}  // namespace

void bind_voxels(nb::module_& m) {
  nb::class_<MarchFrame>(m, "MarchFrame");
  m.def("march", march_checked, "links"_a, "densities"_a, "rows"_a, "bricks"_a, "placements"_a, "step"_a, "origins"_a,
        "directions"_a, "near"_a, "colors"_a, "alpha"_a, "keep"_a);
  m.def("march_backward", march_backward_checked, "frame"_a, "links"_a, "densities"_a, "rows"_a, "bricks"_a,
        "placement"_a, "grad_colors"_a, "grad_alpha"_a, "to_densities"_a, "to_rows"_a);
  m.def("voxel_weights", weights_checked, "links"_a, "densities"_a, "rows"_a, "bricks"_a, "placement"_a, "step"_a,
        "origins"_a, "directions"_a, "near"_a, "most"_a);
  m.def("voxel_variation", variation_checked, "links"_a, "densities"_a, "rows"_a, "begin"_a, "count"_a, "factors"_a,
        "spread"_a, "to_densities"_a, "to_rows"_a);
  m.def("voxel_step", step_checked, "densities"_a, "rows"_a, "grad_densities"_a, "grad_rows"_a, "moment_densities"_a,
        "moment_rows"_a, "rates"_a, "beta"_a, "eps"_a);
}

}  // namespace econgs
