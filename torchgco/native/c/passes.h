/* Passes along a trajectory (passes.c), which are compiled with the model. They are told the functions of what constraints and
   guide add to the cost of a knot (knot.h): the interior point's library has the model's unit, but no such functions. */
#pragma once
#include "problem.h"

typedef V Value(const Lanes *s, int64_t k, const V *x, const V *u);
typedef void Expand(const Lanes *s, int64_t k, const V *x, const V *u, V *g, V *H);
TGCO_BETWEEN_UNITS void roll(Lanes *s, CALLABLE(Value) value, V alpha, V enough, V *cost, V *merit);
TGCO_BETWEEN_UNITS void backward(Lanes *s, CALLABLE(Expand) expand, IN gap, V *linear, V *squares, V *lowest);
TGCO_BETWEEN_UNITS I is_finite(const Lanes *s, CALLABLE(Expand) expand);
TGCO_BETWEEN_UNITS void gaps(const Lanes *s, OUT gap);
TGCO_BETWEEN_UNITS void linear_step(Lanes *s, IN gap);
