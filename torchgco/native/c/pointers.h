/* Pointers to numbers V, which lie on the stack or in the memory of a problem: IN and OUT declare what a function reads and
   writes wherever they lie, and what it makes of these; the types point into a problem's memory alone. cuda/c/strided.h has
   the same where the memory of several problems is interleaved. */
#pragma once
#include "vectors.h" /* or scalar/vectors.h */

#define IN const V *
#define OUT V *
#define OUTS V *const *
#define ALONE restrict /* after IN or OUT: nothing else points there */
#define NONE 0         /* numbers that there are not */
#define CALLABLE(type) type *
#define CALLED(function) function /* as an argument of that type */
#define ADDRESS(numbers) ((double *)(numbers))
typedef V *Numbers;
typedef const V *ConstNumbers;
typedef I *Truths;
typedef int64_t *Places;
