/* What is large of a function's own: here on the stack. Small processors have little of it, so an exported solver has this
   in its workspace (export/c/stack.h). */
#pragma once

/* A structure, and numbers of one stage, which stand from `place` on where functions share them: those of a function and of
   what it calls don't overlap. */
#define LOCAL(type, name, p) type name##_own, *name = &name##_own
#define LOCAL_NUMBERS(t, name, place, count) V name[count]
