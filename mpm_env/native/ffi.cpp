// What XLA calls: unpacks buffers and attributes, and picks the kernels for this processor.
#include <cstdlib>
#include <string_view>

#include "kernels.h"
#include "xla/ffi/api/c_api.h"
#include "xla/ffi/api/ffi.h"

namespace ffi = xla::ffi;

namespace {

using Ints = ffi::Span<const int64_t>;
using Floats = ffi::Span<const double>;

// MPM_ENV_WIDTH=narrow keeps to the narrower registers, for tests.
bool has_wide() {
#if defined(__x86_64__)
  static const char* wish = std::getenv("MPM_ENV_WIDTH");
  if (wish && std::string_view(wish) == "narrow") return false;
  return __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512vl") &&
         __builtin_cpu_supports("avx512bw") && __builtin_cpu_supports("avx512cd");
#else
  return false;
#endif
}

bool has_narrow() {
#if defined(__x86_64__)
  return __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") && __builtin_cpu_supports("bmi2");
#else
  return true;
#endif
}

GridShape grid_of(Ints shape, Ints kinds, Floats friction, double cell_size, int64_t margin) {
  GridShape g{};
  g.dim = int64_t(shape.size());
  for (int64_t a = 0; a < g.dim; ++a) g.shape[a] = shape[a];
  for (int64_t i = 0; i < 2 * g.dim; ++i) { g.wall_kind[i] = kinds[i]; g.wall_friction[i] = friction[i]; }
  g.cell_size = cell_size;
  g.margin = margin;
  return g;
}

// All dimensions in front of an array's own `rank` ones are environments.
int64_t batch_of(const ffi::AnyBuffer& a, size_t rank) {
  int64_t n = 1;
  for (size_t i = 0; i + rank < a.dimensions().size(); ++i) n *= a.dimensions()[i];
  return n;
}

// An operand of own rank `rank`, of one environment each or for all; the environments are those of the result `all`.
Shared shared(const ffi::AnyBuffer& a, size_t rank, ffi::AnyBuffer::Dimensions all) {
  const auto own = a.dimensions();
  int64_t per = 1;
  for (size_t i = own.size() - rank; i < own.size(); ++i) per *= own[i];
  return {a.untyped_data(), per, int64_t(own.size() - rank), own.begin(), all.begin()};
}

// Buffers are read as the type of the first: any other would be misread.
template <class... Buffers> bool alike(const ffi::AnyBuffer& first, const Buffers&... rest) {
  const auto type = first.element_type();
  return (type == ffi::F32 || type == ffi::F64) && ((rest.element_type() == type) && ...);
}
const auto MIXED = [] { return ffi::Error::InvalidArgument("mpm-env: arrays of different precision in one native call."); };

ffi::Error to_nodes(ffi::AnyBuffer x, ffi::AnyBuffer v, ffi::AnyBuffer C, ffi::AnyBuffer tau, ffi::AnyBuffer m,
                    ffi::AnyBuffer V0, ffi::AnyBuffer step, ffi::AnyBuffer watched, ffi::Result<ffi::AnyBuffer> nodes,
                    Ints shape, Ints kinds, Floats friction, double cell_size, int64_t margin, double least_mass) {
  if (!alike(x, v, C, tau, m, V0, step) || watched.element_type() != ffi::S32) return MIXED();
  ToNodes t{};
  t.grid = grid_of(shape, kinds, friction, cell_size, margin);
  t.batch = batch_of(x, 2);
  t.grains = x.dimensions().back();
  t.watch = watched.dimensions().back();
  t.x = x.untyped_data(); t.v = v.untyped_data(); t.C = C.untyped_data(); t.tau = tau.untyped_data();
  t.m = m.untyped_data(); t.V0 = V0.untyped_data(); t.step = step.untyped_data();
  t.watched = static_cast<const int32_t*>(watched.untyped_data());
  t.least_mass = least_mass;
  t.nodes = nodes->untyped_data();
  (has_wide() ? wide::to_nodes : narrow::to_nodes)(t, x.element_type() == ffi::F64);
  return ffi::Error::Success();
}

// The results share memory with the operands of the same name.
ffi::Error to_grains(ffi::AnyBuffer nodes, ffi::AnyBuffer m, ffi::AnyBuffer parameter, ffi::AnyBuffer, ffi::AnyBuffer,
                     ffi::AnyBuffer, ffi::AnyBuffer, ffi::AnyBuffer, ffi::AnyBuffer, ffi::Result<ffi::AnyBuffer> x,
                     ffi::Result<ffi::AnyBuffer> v, ffi::Result<ffi::AnyBuffer> C, ffi::Result<ffi::AnyBuffer> e,
                     ffi::Result<ffi::AnyBuffer> tau, ffi::Result<ffi::AnyBuffer> history, Ints shape, Ints kinds,
                     Floats friction, double cell_size, int64_t margin, int64_t law, int64_t start, int64_t stop) {
  if (!alike(nodes, m, parameter, *x, *v, *C, *e, *tau, *history)) return MIXED();
  ToGrains t{};
  t.grid = grid_of(shape, kinds, friction, cell_size, margin);
  t.batch = batch_of(*x, 2);
  t.grains = x->dimensions().back();
  t.memory = history->dimensions()[history->dimensions().size() - 2];
  t.start = start;
  t.stop = stop;
  t.parameters = parameter.dimensions().back();
  t.law = static_cast<Law>(law);
  t.nodes = nodes.untyped_data(); t.m = m.untyped_data(); t.parameter = parameter.untyped_data();
  t.x = x->untyped_data(); t.v = v->untyped_data(); t.C = C->untyped_data(); t.e = e->untyped_data();
  t.tau = tau->untyped_data(); t.history = history->untyped_data();
  (has_wide() ? wide::to_grains : narrow::to_grains)(t, x->element_type() == ffi::F64);
  return ffi::Error::Success();
}

GeomTable geoms_of(Ints kind, Ints first, Ints nodes, Floats size, Floats reach, Floats origin, Floats spacing,
                   const Shared& voxels) {
  return {int64_t(kind.size()), kind.begin(), first.begin(), nodes.begin(), size.begin(), reach.begin(), origin.begin(),
          spacing.begin(), voxels};
}

ffi::Error near(ffi::AnyBuffer x, ffi::AnyBuffer high, ffi::AnyBuffer pos, ffi::AnyBuffer mat, ffi::AnyBuffer voxels,
                ffi::Result<ffi::AnyBuffer> index, ffi::Result<ffi::AnyBuffer> found, Ints kind, Ints first, Ints nodes,
                Floats size, Floats reach, Floats origin, Floats spacing, double low) {
  if (!alike(x, high, pos, mat) || voxels.element_type() != ffi::F32) return MIXED();
  const auto all = index->dimensions();
  Near t{};
  t.geoms = geoms_of(kind, first, nodes, size, reach, origin, spacing, shared(voxels, 1, all));
  t.batch = batch_of(*index, 1);
  t.points = x.dimensions().back();
  t.room = index->dimensions().back();
  t.low = low;
  t.x = shared(x, 2, all); t.high = shared(high, 1, all); t.pos = shared(pos, 2, all); t.mat = shared(mat, 3, all);
  t.index = static_cast<int32_t*>(index->untyped_data());
  t.found = static_cast<int32_t*>(found->untyped_data());
  (has_wide() ? wide::near : narrow::near)(t, x.element_type() == ffi::F64);
  return ffi::Error::Success();
}

ffi::Error meet(ffi::AnyBuffer x, ffi::AnyBuffer v, ffi::AnyBuffer m, ffi::AnyBuffer pos, ffi::AnyBuffer mat,
                ffi::AnyBuffer centre, ffi::AnyBuffer J, ffi::AnyBuffer d, ffi::AnyBuffer M, ffi::AnyBuffer mu,
                ffi::AnyBuffer hold, ffi::AnyBuffer shares, ffi::AnyBuffer full, ffi::AnyBuffer q_free, ffi::AnyBuffer rows_J,
                ffi::AnyBuffer rows_T, ffi::AnyBuffer rows_law, ffi::AnyBuffer voxels, ffi::Result<ffi::AnyBuffer> phi,
                ffi::Result<ffi::AnyBuffer> n, ffi::Result<ffi::AnyBuffer> q, ffi::Result<ffi::AnyBuffer> impulse,
                ffi::Result<ffi::AnyBuffer> wrench, ffi::Result<ffi::AnyBuffer> residual,
                ffi::Result<ffi::AnyBuffer> scale, ffi::Result<ffi::AnyBuffer> given, Ints kind, Ints first, Ints nodes, Floats size, Floats reach,
                Floats origin, Floats spacing, Ints body_of, int64_t iterations, bool plane_strain, double within,
                double layer, double dt) {
  if (!alike(x, v, m, pos, mat, centre, J, d, M, mu, hold, shares, full, q_free, rows_J, rows_T, rows_law) ||
      voxels.element_type() != ffi::F32)
    return MIXED();
  const auto all = phi->dimensions();
  Meet t{};
  t.geoms = geoms_of(kind, first, nodes, size, reach, origin, spacing, shared(voxels, 1, all));
  t.body_of = body_of.begin();
  t.batch = batch_of(*phi, 1);
  t.points = x.dimensions().back();
  t.bodies = centre.dimensions()[centre.dimensions().size() - 2];
  t.nv = q_free.dimensions().back();
  t.materials = hold.dimensions().back();
  t.rows = rows_law.dimensions().back();
  t.iterations = iterations;
  t.plane_strain = plane_strain;
  t.reach = within;
  t.layer = layer;
  t.dt = dt;
  t.gaps = full.dimensions().back() > 0;
  t.x = shared(x, 2, all); t.v = shared(v, 2, all); t.m = shared(m, 1, all);
  t.pos = shared(pos, 2, all); t.mat = shared(mat, 3, all); t.centre = shared(centre, 2, all);
  t.J = shared(J, 3, all); t.d = shared(d, 2, all); t.M = shared(M, 2, all); t.q_free = shared(q_free, 1, all);
  t.mu = shared(mu, 2, all); t.hold = shared(hold, 1, all); t.shares = shared(shares, 2, all); t.full = shared(full, 1, all);
  t.rows_J = shared(rows_J, 2, all); t.rows_T = shared(rows_T, 2, all); t.rows_law = shared(rows_law, 2, all);
  t.phi = phi->untyped_data(); t.n = n->untyped_data(); t.q = q->untyped_data();
  t.impulse = impulse->untyped_data(); t.wrench = wrench->untyped_data(); t.given = given->untyped_data();
  t.residual = residual->untyped_data(); t.scale = scale->untyped_data();
  (has_wide() ? wide::meet : narrow::meet)(t, x.element_type() == ffi::F64);
  return ffi::Error::Success();
}

#define GRID_ATTRIBUTES \
  .Attr<Ints>("shape").Attr<Ints>("kinds").Attr<Floats>("friction").Attr<double>("cell_size").Attr<int64_t>("margin")
#define GEOM_ATTRIBUTES \
  .Attr<Ints>("kind").Attr<Ints>("first").Attr<Ints>("nodes").Attr<Floats>("size").Attr<Floats>("reach") \
  .Attr<Floats>("origin").Attr<Floats>("spacing")
#define ARG Arg<ffi::AnyBuffer>()
#define RET Ret<ffi::AnyBuffer>()

}  // namespace

XLA_FFI_DEFINE_HANDLER_SYMBOL(mpm_env_to_nodes, to_nodes,
                              ffi::Ffi::Bind().ARG.ARG.ARG.ARG.ARG.ARG.ARG.ARG.RET GRID_ATTRIBUTES.Attr<double>("least_mass"));
XLA_FFI_DEFINE_HANDLER_SYMBOL(mpm_env_to_grains, to_grains,
                              ffi::Ffi::Bind().ARG.ARG.ARG.ARG.ARG.ARG.ARG.ARG.ARG.RET.RET.RET.RET.RET.RET GRID_ATTRIBUTES
                                  .Attr<int64_t>("law").Attr<int64_t>("start").Attr<int64_t>("stop"));
XLA_FFI_DEFINE_HANDLER_SYMBOL(mpm_env_near, near,
                              ffi::Ffi::Bind().ARG.ARG.ARG.ARG.ARG.RET.RET GEOM_ATTRIBUTES.Attr<double>("low"));
XLA_FFI_DEFINE_HANDLER_SYMBOL(mpm_env_meet, meet,
                              ffi::Ffi::Bind().ARG.ARG.ARG.ARG.ARG.ARG.ARG.ARG.ARG.ARG.ARG.ARG.ARG.ARG.ARG.ARG.ARG.ARG
                                  .RET.RET.RET.RET.RET.RET.RET.RET
                                  GEOM_ATTRIBUTES.Attr<Ints>("body_of").Attr<int64_t>("iterations")
                                  .Attr<bool>("plane_strain").Attr<double>("within")
                                  .Attr<double>("layer").Attr<double>("dt"));

// Read through ctypes before anything is registered.
extern "C" {
const char* mpm_env_source() { return MPM_SOURCE; }      // hash of the files that this was built from
int mpm_env_api() { return XLA_FFI_API_MAJOR * 1000 + XLA_FFI_API_MINOR; }
int mpm_env_runs_here() { return has_narrow(); }
const char* mpm_env_width() { return has_wide() ? "AVX-512" : MPM_NARROW; }
}
