// Another control system leads: a rising edge at the start input says go, outputs tell what becomes of it.
// Once an edge was taken the input is deaf until the answer; its flag tells whether more came meanwhile.

#include "box.h"

#include <avr/interrupt.h>
#include <util/atomic.h>

uint16_t signs, n_gos;
uint8_t lead, went;

static uint16_t busy, ready, failed;
static uint8_t more;            // an edge came that could not be taken
static uint16_t patience, due;  // in overflows of the timer; no patience: no deadline

static void sign(uint16_t mask) {
  signs = mask;
  show(held);
}

static void listen(void) {
  started = more = 0;
  TIMSK1 |= _BV(ICIE1);
}

void begin_leading(uint16_t busy_at, uint16_t ready_at, uint16_t failed_at, uint16_t overflows) {
  ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
    busy = busy_at, ready = ready_at, failed = failed_at, patience = overflows;
    lead = IDLE;
    sign(0);
    TIFR1 = _BV(ICF1);  // edges of before do not count
    listen();
  }
}

void end_leading(void) {
  ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
    if (lead != DEAF) {
      TIMSK1 &= ~_BV(ICIE1);
      sign(lead == OWED ? failed : signs & ~busy);
    }
    lead = DEAF;
  }
}

static void see_more(void) {
  if (lead > IDLE && TIFR1 & _BV(ICF1)) {
    TIFR1 = _BV(ICF1);
    more = 1;
  }
}

void look_at_leader(void) {
  see_more();
  if (lead == IDLE && started) {
    lead = OWED;
    due = beats + patience;
    n_gos++;
    went = 1;
    sign(busy);
  } else if (lead == OWED && patience && (int16_t)(beats - due) >= 0) {
    lead = LATE;
    sign(busy | failed);
  }
}

uint8_t more_came(void) { return more; }

uint8_t level(void) { return !!(PINB & _BV(PB0)); }

void answer_leader(uint8_t is_ready) {
  ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
    sign(is_ready && lead != LATE ? ready : failed);
    lead = IDLE;  // an edge since the last look is the next go
    listen();
  }
}
