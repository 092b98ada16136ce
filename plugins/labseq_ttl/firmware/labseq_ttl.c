// A timing box on an ATmega328P at 16 MHz: commands. The protocol is described in PROTOCOL.md, beside this file.
//
// Ten outputs: pins D2 to D7 (port D) and D9 to D12 (port B); bit n of a mask is pin Dn, 1 is on.
// D8 is the start input, D13 the gate: high from the first edge of a program to its end.

#include "box.h"

#include <avr/eeprom.h>
#include <avr/interrupt.h>
#include <avr/wdt.h>

#define MAGIC 0x4C53
#define MOST_MS 0xFFFFF  // of a deadline: half of what the timer's overflows can count

typedef struct {
  uint16_t magic, polarity, serial, crc;
} kept_t;

static kept_t EEMEM kept_in_eeprom;
static uint16_t EEMEM boots_in_eeprom;

static edge_t edges[SLOTS][EDGES];
static uint8_t n_edges[SLOTS];
static kept_t kept;
static uint16_t boots, runs, limit;
static uint8_t cause, armed;  // armed: number of the slot + 1

static void forget(void) {
  armed = 0;
  show(0);
}

static void halt(void) {
  forget();
  cli();
  stop = 0;
  drop_received();
  sei();
  drop_line();
  begin("!off");
  say_number(boots, 4);
  end();
}

static uint16_t kept_crc(void) { return checksum(&kept, sizeof kept - sizeof kept.crc); }

static void keep(void) {
  kept.crc = kept_crc();
  eeprom_update_block(&kept, &kept_in_eeprom, sizeof kept);
}

static void identify(void) {
  reply("ok labseq-ttl");
  say_number(PROTOCOL, 2);
  say_number(kept.serial, 4);
  say_number(boots, 4);
  say_number(cause, 2);
  end();
}

static void tell_state(void) {
  reply(armed ? "ok armed" : "ok idle");
  say_number(boots, 4);
  say_number(runs, 4);
  say_number(held, 4);
  say_number(polarity, 4);
  end();
}

static void set_polarity(void) {
  uint32_t mask;
  if (!mask_given(&mask) || !at_end()) return refuse("arguments");
  polarity = kept.polarity = mask;
  show(held);
  keep();
  accept();
}

static void set_serial(void) {
  uint32_t serial;
  if (!number(&serial, 0xFFFF) || !at_end()) return refuse("arguments");
  kept.serial = serial;
  keep();
  accept();
}

static void set_lines(void) {
  uint32_t mask;
  if (!mask_given(&mask) || !at_end()) return refuse("arguments");
  show(mask);
  accept();
}

static void set_limit(void) {
  uint32_t ms;
  if (!number(&ms, 0xFFFF) || !at_end()) return refuse("arguments");
  limit = (ms * 125 + 4095) / 4096;  // overflows of 32.768 ms
  accept();
}

static void put(void) {
  uint32_t slot, first, ticks, mask;
  if (!number(&slot, SLOTS - 1) || !number(&first, EDGES - 1)) return refuse("arguments");
  if (first > n_edges[slot]) return refuse("gap");
  if (armed == slot + 1) armed = 0;
  n_edges[slot] = first;
  do {
    if (!number(&ticks, 0xFFFFFFFF) || !mask_given(&mask)) return refuse("arguments");
    if (first == EDGES) return refuse("full");
    if (first ? ticks < SHORTEST : ticks != 0) return refuse("short");
    edges[slot][first].ticks = ticks;
    edges[slot][first].mask = mask;
    n_edges[slot] = ++first;
  } while (!at_end());
  reply("ok");
  say_number(first, 2);
  end();
}

static void get(void) {
  uint32_t slot, i;
  if (!number(&slot, SLOTS - 1) || !number(&i, EDGES - 1) || !at_end()) return refuse("arguments");
  if (i >= n_edges[slot]) return refuse("gap");
  reply("ok");
  say_number(edges[slot][i].ticks, 8);
  say_number(edges[slot][i].mask, 4);
  end();
}

static void arm(void) {
  uint32_t slot, n;
  if (!number(&slot, SLOTS - 1) || !number(&n, EDGES) || !at_end()) return refuse("arguments");
  if (!n || n != n_edges[slot]) return refuse("gap");
  armed = slot + 1;
  reply("ok");
  say_number(boots, 4);
  end();
}

static void run(uint8_t external) {
  if (!at_end()) return refuse("arguments");
  if (external && lead != DEAF) return refuse("led");
  if (!armed) return refuse("unarmed");
  uint8_t slot = armed - 1;
  armed = 0;
  accept();
  if (!play(edges[slot], n_edges[slot], external)) return;  // halt() says so
  runs++;
  begin("!done");
  say_number(boots, 4);
  say_number(runs, 4);
  end();
}

static void fire(void) { run(0); }

static void fire_at_start(void) { run(1); }

static void begin_lead(void) {
  uint32_t busy, ready, failed, ms;
  if (!mask_given(&busy) || !mask_given(&ready) || !mask_given(&failed)) return refuse("arguments");
  if (!number(&ms, MOST_MS) || !at_end()) return refuse("arguments");
  begin_leading(busy, ready, failed, ms && ms < 33 ? 1 : ms * 125 / 4096);
  reply("ok");
  say_number(level(), 2);
  end();
}

static void end_lead(void) {
  end_leading();
  accept();
}

static void tell_leader(void) {
  uint32_t is_ready;
  if (!number(&is_ready, 1) || !at_end()) return refuse("arguments");
  if (lead == DEAF) return refuse("deaf");
  cli();
  look_at_leader();
  uint8_t was = lead, more = more_came();
  answer_leader(is_ready);
  sei();
  reply("ok");
  say_number(was, 2);
  say_number(more, 2);
  end();
}

static void tell_lead(void) {
  reply("ok");
  say_number(lead, 2);
  say_number(n_gos, 4);
  say_number(more_came(), 2);
  say_number(level(), 2);
  end();
}

static void all_off(void) {
  forget();
  accept();
}

static const struct {
  const char *name;
  void (*obey)(void);
} commands[] = {
    {"id", identify},   {"state", tell_state}, {"polarity", set_polarity}, {"serial", set_serial},
    {"set", set_lines}, {"timeout", set_limit}, {"put", put},              {"get", get},
    {"arm", arm},       {"fire", fire},         {"await", fire_at_start},  {"off", all_off},
    {"lead", begin_lead}, {"deaf", end_lead},   {"answer", tell_leader},   {"leader", tell_lead},
};

static void answer(void) {
  if (!undamaged()) {
    line[0] = '?';
    return refuse("damaged");
  }
  for (uint8_t i = 0; i < sizeof commands / sizeof *commands; i++) {
    if (is_command(commands[i].name)) return commands[i].obey();
  }
  refuse("unknown");
}

static void begin_life(void) {
  cause = MCUSR;
  MCUSR = 0;
  wdt_enable(WDTO_250MS);
  eeprom_read_block(&kept, &kept_in_eeprom, sizeof kept);
  if (kept.magic != MAGIC || kept.crc != kept_crc()) kept = (kept_t){.magic = MAGIC};
  polarity = kept.polarity;
  show(0);
  DDRD = OUTPUTS_D;
  DDRB = OUTPUTS_B | GATE;
  boots = eeprom_read_word(&boots_in_eeprom) + 1;
  eeprom_update_word(&boots_in_eeprom, boots);
  start_line();
  start_timer();
  sei();
  begin("!boot");
  say_number(boots, 4);
  say_number(cause, 2);
  end();
}

static void look_at_age(void) {
  cli();
  uint8_t old = limit && age >= limit;
  if (old) age = 0;
  sei();
  if (!old || !(held || armed || lead != DEAF)) return;
  forget();
  end_leading();
  begin("!alone");
  say_number(boots, 4);
  end();
}

static void tell_go(void) {
  went = 0;
  begin("!go");
  say_number(boots, 4);
  say_number(n_gos, 4);
  end();
}

int main(void) {
  begin_life();
  for (;;) {
    wdt_reset();
    look_at_age();
    cli();
    look_at_leader();
    sei();
    if (stop) {
      halt();
    } else if (went) {
      tell_go();
    } else if (line_waits()) {
      if (receive()) {
        answer();
        drop_line();
      }
    } else {
      cli();
      if (!line_waits() && !stop && !(started && lead == IDLE)) nap();
      sei();
    }
  }
}
