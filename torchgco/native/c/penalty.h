/* The terms that multipliers and penalty add to L_M for one row of a constraint. */
#pragma once
#include "model.h"

/* The term that a row adds to L_M. */
static inline V worth(const Lanes *s, int equality, V c, V lam) {
    V half = SET(0.5), mu = s->mu;
    if (equality) return tgco_fused(half * mu, c, lam) * c;
    if (s->of->phr) {
        I idle = tgco_fused(mu, c, lam) < SET(0.0);
        return tgco_choose(idle, -half * lam * lam * s->inverse_mu, tgco_fused(half * mu, c, lam) * c);
    }
    I idle = (c < SET(0.0)) & (lam == SET(0.0));
    return tgco_fused(half * tgco_if(NOT(idle), mu), c, lam) * c;
}

/* First and second derivative of `worth` by c; where `optimality` is set, of lam c with the penalty's curvature, or where it
   is 2 with that of a barrier, lam / slack. */
static inline V pull(const Lanes *s, int equality, V c, V lam, V *rho) {
    const Problem *p = s->of;
    V mu = s->mu;
    if (p->optimality) { /* rows that bind, as lagrangian.binding has it */
        I binds = lam != SET(0.0);
        if (p->optimality == 2) {
            *rho = tgco_if(binds, tgco_fabs(lam) / tgco_maximum(tgco_fabs(c), SET(LEAST_SLACK)));
            return lam;
        }
        if (!equality) binds &= lam > -c;
        *rho = tgco_if(binds, mu);
        return lam;
    }
    if (equality) { *rho = mu; return tgco_fused(mu, c, lam); }
    I idle = p->phr ? tgco_fused(mu, c, lam) < SET(0.0) : (c < SET(0.0)) & (lam == SET(0.0));
    *rho = tgco_if(NOT(idle), mu);
    V g = tgco_fused(*rho, c, lam);
    return p->phr ? tgco_if(NOT(idle), g) : g;
}

/* Adds the derivatives of the term of a row c with its slopes by position. */
static inline void add_slopes(const Lanes *s, V c, V lam, IN slopes, OUT g, OUT H) {
    V rho, slope = pull(s, 0, c, lam, &rho);
    for (int a = 0; a < DIM; a++) {
        ADD(g[POSITION + a], slope, slopes[a]);
        for (int b = a; b < DIM; b++) ADD(H[(POSITION + a) * S + POSITION + b], rho * slopes[a], slopes[b]);
    }
}
