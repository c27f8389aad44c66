/* For editors: what the text that Python writes for a form of problems (native/codegen) defines beside functions of
   model.h. */
#pragma once

#include "../model.h"

void tgco_step(const V *x, const V *u, const V *p, const double *w, V *next);
void tgco_jacobian(const V *x, const V *u, const V *p, const double *w, V *f);
void tgco_gather(const V *P, const V *f, V *T); /* T = P [fx fu] */
void tgco_product(const V *f, const V *T, V *H); /* H = [fx fu]' T */
void tgco_pull_back(const V *p, const V *f, V *g); /* g = [fx fu]' p */

void tgco_stage_value(const V *x, const V *u, const V *p, const double *w, V *value);
void tgco_stage_entries(const V *x, const V *u, const V *p, const double *w, V *e);
void tgco_last_value(const V *x, const V *u, const V *p, const double *w, V *value);
void tgco_last_entries(const V *x, const V *u, const V *p, const double *w, V *e);
enum { STAGE_SLOPES = 1, STAGE_ENTRIES = 2, LAST_SLOPES = 1, LAST_ENTRIES = 2 };
static const int tgco_stage_places[2], tgco_last_places[2];
