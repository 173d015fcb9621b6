#pragma once

void appMain();

/* Stand-in only: run it for so many of its delays. */
void run_app(int allowed);
