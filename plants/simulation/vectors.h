/* Vectors of LANES rows, and what CasADi's functions on scalars are called on vectors. */
#include <math.h>

#define WITHIN static inline __attribute__((always_inline))

typedef double Vector __attribute__((vector_size(8 * LANES)));
typedef long Mask __attribute__((vector_size(8 * LANES)));

#define ALL(x) ((Vector){0} + (x))
#define TRUTH(mask) ((Vector)((mask) & (Mask)ALL(1.)))

WITHIN Vector pick(Mask mask, Vector x, Vector y) {
  return (Vector)((mask & (Mask)x) | (~mask & (Mask)y));
}
WITHIN Vector lanes_sq(Vector x) { return x * x; }
WITHIN Vector lanes_fabs(Vector x) { return pick(x > 0., x, -x); }
WITHIN Vector lanes_fmin(Vector x, Vector y) { return pick(x < y, x, y); }
WITHIN Vector lanes_fmax(Vector x, Vector y) { return pick(x > y, x, y); }
WITHIN Vector lanes_sign(Vector x) { return pick(x < 0., ALL(-1.), pick(x > 0., ALL(1.), x)); }
WITHIN Vector lanes_if_else(Vector c, Vector x) { return (Vector)((c != 0.) & (Mask)x); }

#define LANE_BY_LANE_1(name) \
  WITHIN Vector lanes_##name(Vector x) { \
    long l; \
    for (l = 0; l < LANES; l++) x[l] = name(x[l]); \
    return x; \
  }
#define LANE_BY_LANE_2(name) \
  WITHIN Vector lanes_##name(Vector x, Vector y) { \
    long l; \
    for (l = 0; l < LANES; l++) x[l] = name(x[l], y[l]); \
    return x; \
  }
