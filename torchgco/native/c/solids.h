/* Rows of bounds and of all kinds of obstacles; problems without a position have bounds alone. */
#pragma once
#include "rows.h"
#if DIM > 0
#include "boxes.h"
#include "field.h"
#include "body.h"
#endif
