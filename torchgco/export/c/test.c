/* Compares @PERIODS@ periods with those that torchgco found in Python: @SAME@. */
#include "NAME.h"
#include <math.h>
#include <stdio.h>

#define PERIODS @PERIODS@
@TABLES@

static NAME_workspace workspace;

int main(void) {
    double u[NAME_NU], worst = 0;
    int same = 0, close = 0;
    for (int k = 0; k < PERIODS; k++) {
        int first = @IS_FIRST@, equal = 1;
        if (first) NAME_init(&workspace@ELEMENT@);
        int status = NAME_step(&workspace, states + k * NAME_NX, first ? 0 : @ELAPSED@, INFINITY, u);
        for (int j = 0; j < NAME_NU; j++) {
            double away = fabs(u[j] - controls[k * NAME_NU + j]);
            equal &= away <= near[j];
            if (away > worst) worst = away;
        }
        same += equal && status == NAME_CONVERGED@ITERATIONS@;
        close += status == NAME_CONVERGED;
    }
    printf("%d of %d periods have @SAME@; %d converged; largest difference %g\n", same,
        PERIODS, close, worst);
    if (same < PERIODS) printf("@OTHERWISE@\n");
    return same < PERIODS;
}
