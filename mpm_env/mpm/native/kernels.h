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

#define DECLARE(isa) namespace isa { void to_nodes(const ToNodes&, bool f64); void to_grains(const ToGrains&, bool f64); }
DECLARE(wide)
DECLARE(narrow)
#undef DECLARE
