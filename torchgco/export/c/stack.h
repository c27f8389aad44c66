/* What is large of a function's own, in the workspace: stack.h of the solver has it on the stack. */
#pragma once
#include "problem.h"

#define STAGE_NUMBERS (S * S + S * NX + NX * NX)
#define LOCAL(type, name, p) type *name = (type *)take(p, sizeof(type))

typedef struct {
    unsigned char *next, *end;
    double (*seconds)(void); /* NULL: no time passes */
#if STAGE_NUMBERS > ON_STACK /* fewer are reached faster on the stack */
    V stage[STAGE_NUMBERS];
#define LOCAL_NUMBERS(t, name, place, count) V *const name = ((Arena *)(t)->lanes.of->arena)->stage + (place)
#else
#define LOCAL_NUMBERS(t, name, place, count) V name[count]
#endif
} Arena;
