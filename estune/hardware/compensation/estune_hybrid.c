/* Hybrid control of a reel: position and tension, with the hand-over (36) and (37).
 *
 *     static estune_hybrid reel;
 *     estune_hybrid_init(&reel);
 *     in_tension = estune_hybrid_select(&reel, tension, solved);
 *     setpoint = estune_hybrid_setpoint(distributed, solved);
 *     effort = estune_hybrid_step(&reel, forward, limit, position_setpoint, position, setpoint,
 *                                 tension, in_tension);
 *
 * Positions are metres of cable wound in, solved is 1 where the tension distribution has a
 * solution, forward is what is fed forward, limit the greatest effort that the drive gives, N, or
 * zero. Include it after estune_pidf.c.
 */
#ifndef ESTUNE_HYBRID_EXPORT
#define ESTUNE_HYBRID_EXPORT static inline
#endif

typedef struct {
  estune_pidf position, tension;
  int in_tension; /* the selection at the last sample */
} estune_hybrid;

/* Both at rest, tension control selected; see estune_pidf_at_rest. */
ESTUNE_HYBRID_EXPORT void estune_hybrid_init(estune_hybrid *hybrid) {
  estune_pidf_init(&hybrid->tension);
  estune_pidf_gains(&hybrid->position, ESTUNE_POSITION_GAINS);
  estune_pidf_at_rest(&hybrid->position, 0, 0);
  hybrid->in_tension = 1;
}

/* 1 for tension control: with a solution, or until the tension is a margin above the least. */
ESTUNE_HYBRID_EXPORT int estune_hybrid_select(const estune_hybrid *hybrid, double tension,
                                              int solved) {
  double release = ESTUNE_TENSION_LEAST + (hybrid->in_tension ? ESTUNE_TENSION_MARGIN : 0.0);
  return solved || tension < release;
}

ESTUNE_HYBRID_EXPORT double estune_hybrid_setpoint(double distributed, int solved) {
  if (!solved) return ESTUNE_TENSION_LEAST + 2.0 * ESTUNE_TENSION_MARGIN;
  return distributed > ESTUNE_TENSION_LEAST ? distributed : ESTUNE_TENSION_LEAST;
}

/* One sample: the controller that is not selected tracks the effort of the other. */
ESTUNE_HYBRID_EXPORT double estune_hybrid_step(estune_hybrid *hybrid, double forward,
                                               double limit, double position_setpoint, double position,
                                               double tension_setpoint, double tension,
                                               int in_tension) {
  int was = hybrid->in_tension;
  estune_pidf *active = was ? &hybrid->tension : &hybrid->position;
  estune_pidf *other = was ? &hybrid->position : &hybrid->tension;
  double r = was ? tension_setpoint : position_setpoint, y = was ? tension : position;
  double others_r = was ? position_setpoint : tension_setpoint;
  double others_y = was ? position : tension, effort, following;
  effort = estune_pidf_step_beside(active, forward, limit, r, y, 0);
  estune_pidf_take_over(other, others_r, others_y, effort - forward);
  following = estune_pidf_step_beside(other, forward, limit, others_r, others_y, 0);
  hybrid->in_tension = in_tension;
  return in_tension == was ? effort : following;
}
