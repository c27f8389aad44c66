/* NAME: @TITLE@. README.md says how it is used; all numbers are @REAL@, but times. */
#ifndef NAME_H
#define NAME_H
#include <stdint.h>
#ifdef __cplusplus
extern "C" {
#endif

#define NAME_NX @NX@ /* states */
#define NAME_NU @NU@ /* controls */
#define NAME_N @N@ /* stages, of @DT@ s */
#define NAME_@DEFINED@
@ELEMENTS@
enum {
@STATUSES@
    NAME_BAD_STATE = -1, /* x or @MOVES@ are no finite numbers, or @MOVES@ below 0 */
    NAME_BAD_NUMBER = -2 /* one of `numbers` is one that the problem can't have */
};

/* What may change from step to step. */
typedef struct {
@NUMBERS@
} NAME_numbers;

typedef struct {
    NAME_numbers numbers; /* to be written between steps */
    double (*clock)(void); /* the time, s, for `max_seconds`; 0: it has no effect */
    int max_iterations; /* of a step, in all; 0: @MAX_ITERATIONS@ for each of its solves */
@ELEMENT_FIELD@    double period; /* s: u is the plan's mean over it; 0, or up to a stage: that of its first stage */

    /* What the last step found. */
    int status; /* see above: how the last solve ended */
    int held; /* 1: u isn't of a plan that was found for now, but of the one before, with feedback, or at rest */
    int warm; /* 1: the solve that began with the plan before was enough */
    int iterations; /* of all solves of the step */
    double violation; /* the largest of the last solve, metres for lengths */

    /* The plan that is flown: u = U + K (x - X); X[k * NAME_NX + i], U[k * NAME_NU + j], K[(k * NAME_NU + j) * NAME_NX + i]. */
    double X[@SIZE_X@], U[@SIZE_U@], K[@SIZE_K@];
@TIMES_FIELD@    double age; /* @AGE@ since its first knot; below 0: there is none */

    /* The solver's own: where it begins, and room that only a step needs. */
    int begun, able;
    double x[@SIZE_x@], u[@SIZE_u@];
@MULTIPLIERS@@BEFORE@
    double room[@ROOM@];
} NAME_workspace;

/* Makes a workspace ready: the numbers are those that were exported, @NO_PLAN@@THAT@ */
void NAME_init(NAME_workspace *w@OF_ELEMENT@);

/* Controls u for the next period from states x measured now. @MOVED_BY@,
   and the solver goes on from there; where that fails it begins again from what the plan before leads to now, then from rest, while
   iterations and seconds are left; where all fail, u is the plan before with feedback. u is within the bounds of controls.
   Returns the status. max_seconds: INFINITY for none. */
int NAME_step(NAME_workspace *w, const double x[NAME_NX], double @MOVES@, double max_seconds, double u[NAME_NU]);

/* The next step begins with this plan, of states X (N+1, NX) and controls U (N, NU)@GUESS_NAMED@, from any larger computer. */
void NAME_guess(NAME_workspace *w, const double *X, const double *U@GUESS_TIMES@);

/* Forgets the plan; numbers stay, but for those that steps write. */
void NAME_reset(NAME_workspace *w);

#ifdef __cplusplus
}
#endif
#endif
