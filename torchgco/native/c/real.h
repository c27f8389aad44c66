/* What is known of numbers of type REAL, double or float. */
#pragma once

#define TGCO_SUFFIX_double
#define TGCO_SUFFIX_float f
#define TGCO_IS_DOUBLE_double 1
#define TGCO_IS_DOUBLE_float 0
#define TGCO_JOIN_(a, b) a##b
#define TGCO_JOIN(a, b) TGCO_JOIN_(a, b)
#define TGCO_IS_DOUBLE TGCO_JOIN(TGCO_IS_DOUBLE_, REAL)
#if TGCO_IS_DOUBLE
#define TGCO_EXPONENT 52
#define TGCO_BIAS 1023
#define TGCO_FACTORS 8 /* slacks whose product is in range */
#define TGCO_WHOLE 0x1.8p52 /* adding it leaves the nearest whole number in the lowest bits */
#else
#define TGCO_EXPONENT 23
#define TGCO_BIAS 127
#define TGCO_FACTORS 1
#define TGCO_WHOLE 0x1.8p23
#endif
