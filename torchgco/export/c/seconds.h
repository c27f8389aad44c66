/* The time of an exported solver, by its user's clock. */
#pragma once
static double seconds_of(const void *arena);
#define SECONDS_NOW(how) seconds_of((how)->of->arena)
#define SECONDS_BEGUN(how) SECONDS_NOW(how)
