"""Rigid bodies as a grid sees them: where they are, how they resist, and what contact with grains does to both.

Knows MuJoCo and MJX, no grains: it is handed points with a mass and a velocity, grid nodes or grains alike.

    geoms        signed distance of each MuJoCo geom
    voxels       the distances to a mesh, computed once and kept on disk
    reach        how far points are from the bodies, on the host
    bodies       which geoms couple, where they are over one rigid step, and the rigid step itself
    contact      points against geoms: distance, normal, and the law of separation, sticking and sliding
    constraints  rigid contacts, limits and equalities, as laws that hold while grains push
    exchange     the impulses between points and bodies, solved together with the joint-space mass matrix
    meeting      both for many points at once, in JAX or by the native kernels: what a substep calls
"""
