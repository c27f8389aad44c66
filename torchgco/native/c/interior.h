/* The interior point's data: constraints are c(x, u) + s = 0 with slacks s > 0, or c(x, u) = 0. */
#pragma once
#include "model.h"
#include "stack.h" /* or export/c/stack.h */
#include "triangle.h"

/* Of a row, see interior_fixed.h: outside the barrier all but the first. FIXED holds as an equality, BESIDE coincides with
   what does, or is to. */
enum { INSIDE, LEFT_OUT, BESIDE, FIXED };

typedef struct {
    Lanes lanes;
    const Interior *how;
    Numbers y, yn;               /* (N+1, NX): costates of the states, and those of a full step */
    Numbers gap, gapn, aim;      /* (N, NX): step(x, u) - x', of iterate and trial, and what a step is to close */
    Numbers H, f;                /* (N+1, S, S) as triangles, (N, NJ) */
    Numbers cost_slope, g[PARTS]; /* (N+1, S): cost; with J' of multipliers, of the condensed residuals, of 1 / s */
    Numbers P, p, L;             /* (N+1, NX, NX), (N+1, NX), (N, NU, NU): the Riccati recursion, as triangles */
    Numbers is_free, L_start;    /* (NX): 1 where the start is free; (NX, NX): its factor. None where none is free */
    Numbers dx, du;              /* (N+1, NX), (N, NU) */
    Numbers c, cn, s, sn, z, r, ds, dz;   /* (rows): values, slacks, multipliers, residuals, and of trial and step */
    Numbers room; /* (rows): half the range between two bounds, 1 at most; in lanes that are `relaxed` by how much a row is */
    I relaxed;    /* lanes whose rows are */
    Numbers role; /* (rows): a Role */
    int some_out; /* whether a row of inequalities is outside the barrier in a lane */
    double admitted; /* violation of rows outside, up to which they stay there */
    int64_t *first, rows;        /* the first row of each constraint, and how many there are, also at its end */
    Numbers across[3]; /* (widest): numbers of the rows of one constraint at one knot */
    Numbers moves; /* (rows): 1 where a change of all free variables moves it */
    int64_t widest; /* rows of a constraint at a knot, at most */
    V mu, shift, scale;
    V raised;    /* how many times larger the scale is than it would be in the units of the problem */
    V objective; /* 0 where feasibility alone is sought */
    Numbers gives; /* (rows): by how much more than `soft` says. None where no row is an equality */
    V soft;      /* dual regularisation: a step fulfils equalities up to so much of the change of their multipliers */
    Numbers kept; /* the iterate before the steps on trial */
    I live; /* lanes whose problem isn't over */
    double **rows_asked; /* of each constraint: the numbers of its rows, where Python computes them */
    Numbers memory;
} Barrier;

/* In riccati.c. */
TGCO_BETWEEN_UNITS I factor(Barrier *t, I open);
TGCO_BETWEEN_UNITS void solve(Barrier *t);
