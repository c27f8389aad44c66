/* An example: @EXAMPLE@ periods of a vehicle that does what the plan says. */
#include "NAME.h"
#include <math.h>
#include <stdio.h>

static NAME_workspace workspace; /* one per vehicle and thread; a local one would lie on the stack */

int main(void) {
    double x[NAME_NX] = {@X0@}, u[NAME_NU];
    int failed = 0;
    NAME_init(&workspace@FIRST@);
    for (int period = 0; period < @EXAMPLE@; period++) {
        int status = NAME_step(&workspace, x, @MOVED@, INFINITY, u);
        printf("%2d: status %d, %2d iterations, u", period, status, workspace.iterations);
        for (int j = 0; j < NAME_NU; j++) printf(" % .6f", u[j]);
        printf("\n");
        failed += workspace.held;
        for (int i = 0; i < NAME_NX; i++) x[i] = workspace.X[NAME_NX + i]; /* a real vehicle is measured here */
    }
    return failed;
}
