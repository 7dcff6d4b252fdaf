// What the kernels are called with: plain pointers and numbers, so that they need no other header.
#pragma once
#include <cstdint>

enum Law : int64_t { NO_LAW = 0, ELASTIC = 1, SAND = 2, SNOW = 3 };
enum WallKind : int64_t { SLIP = 0, STICK = 1, SEPARATE = 2, OPEN = 3 };

// The grid: node (0, ..) is at the origin; the walls' planes lie `margin` nodes inside its ends.
struct GridShape {
  int64_t dim, shape[3], margin, wall_kind[6];  // walls: lower and upper side of each axis
  double wall_friction[6], cell_size;
};

// Grains to nodes. Arrays have the layout of `Particles`, `batch` of them behind each other; nodes are
// (batch, *shape, 4): velocity after forces, gravity and walls, and mass. Where no grain reaches, only watched nodes are set.
struct ToNodes {
  GridShape grid;
  int64_t batch, grains, watch;
  const void *x, *v, *C, *tau, *m, *V0, *step;  // step: time step, gravity
  const int32_t* watched;
  double least_mass;
  void* nodes;
};

// Nodes to grains: gather, move, strain, and the law's answer, in place for the slots from start to stop.
struct ToGrains {
  GridShape grid;
  int64_t batch, grains, memory, start, stop, parameters;
  Law law;
  const void *nodes, *m, *parameter;  // parameter: time step, then the law's own
  void *x, *v, *C, *e, *tau, *history;
};

// An array of one environment each, or one for all: `per` numbers behind each other; in front of them as many dimensions
// as `all` has, each as long as there or 1.
struct Shared {
  const void* data;
  int64_t per, rank;
  const int64_t *own, *all;

  template <class S> const S* of(int64_t environment) const {
    int64_t row = 0, stride = 1;
    for (int64_t k = rank; k-- > 0; environment /= all[k], stride *= own[k])
      if (own[k] > 1) row += environment % all[k] * stride;
    return static_cast<const S*>(data) + row * per;
  }
};

enum GeomKind : int64_t { PLANE = 0, SPHERE = 2, CAPSULE = 3, ELLIPSOID = 4, CYLINDER = 5, BOX = 6, MESH = 7 };  // MuJoCo's

// Rigid geoms, but for where they are. A mesh has nodes[3 g ..] distances in `voxels` from its `first` one on.
struct GeomTable {
  int64_t count;
  const int64_t *kind, *first, *nodes;
  const double *size, *reach, *origin, *spacing;
  Shared voxels;
};

// Points near geoms: which of them are between `low` and their own `high` away; `room` indices, `points` where there are
// fewer, and how many there are.
struct Near {
  GeomTable geoms;
  int64_t batch, points, room;
  double low;
  Shared x, high, pos, mat;
  int32_t *index, *found;
};

// Points that meet bodies: those with mass and nearer than `reach` to a geom exchange momentum with them. Arrays are
// those of coupling/meeting.py.
struct Meet {
  GeomTable geoms;
  const int64_t* body_of;
  int64_t batch, points, bodies, nv, materials, rows, iterations;
  bool gaps;          // whether `full` is given: nodes, which tell how far away their material is
  bool plane_strain;  // normals lie in the plane y = 0
  double reach, layer, dt;
  Shared x, v, m, pos, mat, centre, J, d, M, mu, hold, shares, full, q_free, rows_J, rows_T, rows_law;
  void *phi, *n, *q, *impulse, *wrench, *residual, *scale, *given;
};

#define DECLARE(isa)                          \
  namespace isa {                             \
  void to_nodes(const ToNodes&, bool f64);    \
  void to_grains(const ToGrains&, bool f64);  \
  void near(const Near&, bool f64);           \
  void meet(const Meet&, bool f64);           \
  }
DECLARE(wide)
DECLARE(narrow)
#undef DECLARE
